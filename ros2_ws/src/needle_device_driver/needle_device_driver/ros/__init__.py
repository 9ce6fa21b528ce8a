"""The `device/...` interface and the node on real drives."""
