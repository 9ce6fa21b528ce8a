"""Scenes to train the needle map on: floors, needles, clutter and light, drawn at random."""
