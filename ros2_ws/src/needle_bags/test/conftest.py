"""Bags that tests share: made-up runs, the start of the committed bag, and its report."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made_up_run import STORE, copy_messages, make_run, serialized, write_run
from needle_bags.format.bag_writer import BagCopy
from needle_bags.reading.bag_messages import SentMessage, read_contents
from needle_bags.reading.bag_reader import Run, read_run
from needle_bags.report import report

__all__ = ["make_run"]

BAG = Path(__file__).resolve().parents[4] / "bags" / "regression"
COMMAND = "scripts/simulate --level=tip --params='a <file>.yaml'"


@pytest.fixture(autouse=True)
def _no_git(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("needle_bags.rerun.rerun_bag.commit", lambda: "0123abc")


@pytest.fixture(scope="session")
def regression() -> Path:
    return BAG


@pytest.fixture(scope="session")
def made_up(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A made-up run, as read from its bag."""
    return read_run(write_run(tmp_path_factory.mktemp("made_up") / "run"))


@pytest.fixture(scope="session")
def cut_bag(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], Path]:
    """Return a function that copies the committed bag up to an insertion [m]."""
    run, contents = read_run(BAG), read_contents(BAG)

    def cut(insertion: float) -> Path:
        row = int(np.searchsorted(run.joints.values[:, 0], insertion))
        bag, end = tmp_path_factory.mktemp("cut") / "bag", run.joints.received[row]
        copy = BagCopy(bag, contents.distribution, contents.custom_data)
        copy_messages(BAG, copy, lambda message: message.data if message.log_time < end else None)
        copy.close()
        return bag

    return cut


@pytest.fixture(scope="session")
def eight_steps(cut_bag: Callable[[float], Path]) -> Path:
    return cut_bag(8e-3)


@pytest.fixture(scope="session")
def first_pictures(cut_bag: Callable[[float], Path]) -> Path:
    return cut_bag(30.5e-3)


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, str]:
    """The committed bag with a NaN tip and markup in its texts, and its report."""
    bag = tmp_path_factory.mktemp("reported") / "bag"
    contents = read_contents(BAG)
    custom = contents.custom_data | {
        "run_info": f'{{"level": "camera", "command": "{COMMAND}"}}',
        "versions": '{"system": "<script>alert(1)</script>"}',
    }
    copy = BagCopy(bag, contents.distribution, custom)
    tips = itertools.count(1)

    def spoil(message: SentMessage) -> bytes:
        if message.topic == "/needle/tip" and next(tips) == 60:
            tip: Any = STORE.deserialize_cdr(message.data, message.type_name)
            tip.point.x = math.nan
            return serialized(tip)
        return message.data

    copy_messages(BAG, copy, spoil)
    copy.close()
    assert report.main([str(bag)]) == 0
    return read_run(bag), (bag / "report.html").read_text()
