"""A master of both emulated drives."""

from __future__ import annotations

import pytest

from .master import Master


@pytest.fixture
def master() -> Master:
    return Master()
