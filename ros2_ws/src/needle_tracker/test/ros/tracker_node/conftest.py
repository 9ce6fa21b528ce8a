"""A node under test in a context of its own, and what its cameras see."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from rclpy.context import Context

from own_context import own_context

from .node_bench import INSERTION, Bench, Drawer, Images


@pytest.fixture(scope="module")
def images(draw_pair: Drawer, make_arc: Callable[..., np.ndarray]) -> Images:
    return draw_pair(make_arc(INSERTION, 5.0, 1.0))


@pytest.fixture
def context() -> Iterator[Context]:
    with own_context() as context:
        yield context


@pytest.fixture
def bench(context: Context) -> Iterator[Bench]:
    bench = Bench(context)
    yield bench
    bench.close()
