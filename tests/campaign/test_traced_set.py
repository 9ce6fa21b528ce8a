"""The set of path-traced pairs: what is in it, and that what was drawn is not drawn again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from campaign.tracking import traced_set
from campaign.tracking.traced_set import HELD_BACK, LOOKED_AT, PAIRS, drawn, scenes
from campaign.tracking.traced_study import Told, traced_looks


def test_the_halves_share_no_scene_and_have_enough_pairs() -> None:
    held_back, looked_at = scenes(HELD_BACK), scenes(LOOKED_AT)
    assert not {scene.seed for scene in held_back} & {scene.seed for scene in looked_at}
    with_needle = [scene for scene in held_back + looked_at if scene.look.needle]
    assert len(with_needle) * PAIRS >= 600
    without = [scene for scene in held_back if not scene.look.needle]
    assert len(without) * PAIRS * len(Told) >= 300
    assert {scene.rig for scene in without} == set(traced_set.RIGS)


def test_what_is_there_is_read_and_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = next(scene for scene in scenes(LOOKED_AT) if scene.rig == "webcams")
    black = np.zeros((2, 480, 640), np.uint8)
    arrays: dict[str, np.ndarray] = {
        "empty": black,
        "pairs": np.stack([black] * PAIRS),
        "insertions": np.linspace(0.03, 0.035, PAIRS),
        "tips": np.zeros((PAIRS, 3)),
        "seen": np.ones((PAIRS, 2)),
    }
    traced: list[str] = []

    def trace(_: Path, what: traced_set.TracedScene) -> dict[str, np.ndarray]:
        traced.append(what.name)
        return arrays

    monkeypatch.setattr(traced_set, "_traced", trace)
    for _ in range(2):
        (sequence,) = drawn(tmp_path, [scene])
    assert traced == [scene.name]
    looks = list(traced_looks(sequence))
    assert len(looks) == (PAIRS - 3) * len(Told)
    assert all(look.tip is None for look in looks)
