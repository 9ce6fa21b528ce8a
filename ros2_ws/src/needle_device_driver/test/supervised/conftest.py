"""Benches with a supervisor, on ideal axes and on scripted drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from .drive_bench import DriveBench
from .ideal_axes import Bench


@pytest.fixture(scope="session")
def make_bench() -> type[Bench]:
    return Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def make_drive_bench() -> Iterator[Callable[..., DriveBench]]:
    benches: list[DriveBench] = []

    def make(**parameters: Any) -> DriveBench:
        benches.append(DriveBench(**parameters))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


@pytest.fixture
def drive_bench(make_drive_bench: Callable[..., DriveBench]) -> DriveBench:
    return make_drive_bench()
