"""Random scenes to train the needle map: floors, needles, clutter and light."""
