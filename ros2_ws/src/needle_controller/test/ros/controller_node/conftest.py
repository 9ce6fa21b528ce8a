"""A node under test in a context of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from rclpy.context import Context

from own_context import own_context

from .node_bench import Bench


@pytest.fixture
def context() -> Iterator[Context]:
    with own_context() as context:
        yield context


@pytest.fixture
def bench(context: Context) -> Iterator[Bench]:
    bench = Bench(context, target_offset=0.003)
    yield bench
    bench.close()
