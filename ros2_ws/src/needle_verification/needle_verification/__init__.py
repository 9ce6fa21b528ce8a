"""What the rig's software must be able to show; no rig needs it."""
