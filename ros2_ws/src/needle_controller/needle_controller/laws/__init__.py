"""Control laws: an estimate in, the rotation of the next step out."""
