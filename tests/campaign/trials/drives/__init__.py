"""Faults and steps of drives and driver."""
