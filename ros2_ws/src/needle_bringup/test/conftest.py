"""The fixture of made-up runs."""

from __future__ import annotations

from made_up_run import make_run

__all__ = ["make_run"]
