"""One answer for every stereo pair."""
