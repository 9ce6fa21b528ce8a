"""Judgement of a run from outside: what must hold, and who hears what."""
