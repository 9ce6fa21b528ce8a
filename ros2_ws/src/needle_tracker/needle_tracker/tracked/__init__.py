"""Tip from an electromagnetic or optical tracker: registration, link and component."""
