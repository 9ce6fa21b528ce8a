"""Emulated CiA 402 drives with their motors."""
