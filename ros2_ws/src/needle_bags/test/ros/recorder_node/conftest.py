"""A domain with a source of messages."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from needle_core.process.ros_domain import own_domain

from .recorder_process import Source


@pytest.fixture
def domain() -> Iterator[int]:
    with own_domain() as number:
        yield number


@pytest.fixture
def source(domain: int) -> Iterator[Source]:
    one = Source(domain)
    yield one
    one.close()
