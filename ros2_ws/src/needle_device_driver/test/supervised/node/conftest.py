"""Drivers in this process, each with a rig around it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from needle_device_driver import device_driver
from own_context import own_context

from .node_bench import Rig, emulated_as


@pytest.fixture
def make_rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    monkeypatch.setattr(device_driver, "are_emulated", emulated_as(True))
    with own_context() as context:
        rigs: list[Rig] = []

        def make(**parameters: Any) -> Rig:
            rigs.append(Rig(context, **parameters))
            return rigs[-1]

        yield make
        for rig in rigs:
            rig.close()
