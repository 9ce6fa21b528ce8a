"""From images of a board to the calibration of the rig, and whether it still holds."""
