"""The recorder's writing half."""
