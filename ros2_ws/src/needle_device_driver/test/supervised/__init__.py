"""Supervisor on ideal axes, and on drives behind a CAN bus."""
