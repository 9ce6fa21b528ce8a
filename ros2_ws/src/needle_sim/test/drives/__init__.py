"""Tests of the emulated drives."""
