"""The step protocol: when the needle is moved, and based on which data."""
