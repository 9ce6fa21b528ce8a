"""Ports: connections with a thread of their own."""
