"""Scenarios of the safety rules that depend on the drives, for any backend with an emulator."""
