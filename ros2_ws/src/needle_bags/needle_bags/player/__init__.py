"""Playback of a bag: options, names and clock."""
