"""Motion supervisor: every safety rule of the rig, once."""
