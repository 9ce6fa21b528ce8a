"""Computers of a trial that are one machine: networks, a cable, light."""
