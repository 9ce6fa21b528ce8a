"""The stages of `rerun`, with the nodes' own conversions."""
