"""The hypothesis filter of preset `best`."""
