"""The made-up run that tests of bags share."""

from made_up_run import make_run

__all__ = ["make_run"]
