"""The console's node: what it hears becomes a snapshot, what a person wants becomes messages."""
