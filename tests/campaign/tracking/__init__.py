"""Studies of the tracker: drawn and path-traced needles, calibrations from drawn boards."""
