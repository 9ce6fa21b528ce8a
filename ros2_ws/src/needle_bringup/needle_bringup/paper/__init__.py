"""Reproduction of [KC09] section IV."""
