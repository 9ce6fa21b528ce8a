"""Proof of what the rig's software must be able to do; no rig needs it."""
