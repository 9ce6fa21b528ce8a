"""Drawings and texts made from snapshots of plain data."""
