"""What is drawn and said, from snapshots of plain data."""
