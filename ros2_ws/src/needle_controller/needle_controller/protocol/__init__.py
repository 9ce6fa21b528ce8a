"""The step protocol: when the needle is moved, by what data, and when not."""
