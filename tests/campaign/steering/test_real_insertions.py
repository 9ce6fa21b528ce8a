from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from campaign.steering.real_insertions import compare, position_at, tips_of
from needle_core.errors import UserError

RADIUS = 2.0


def write(path: Path, depth: float) -> Path:
    """Write an insertion along an arc as trajcontrol does: mm, along -y, and zeros at first."""
    y = np.arange(0.005, -depth - 1e-9, -0.001)
    x, z = -0.025 + y**2 / (2.0 * RADIUS), 0.020 + 0.0 * y
    lines = ["Robot x,Tip x, Tip y, Tip z,Tip sec,Tip nanosec", "0,0,0,0,0,0"]
    for n, (a, b, c) in enumerate(1e3 * np.stack([x, y, z], axis=-1)):
        # The same tip is recorded twice.
        lines += [f"0,{a},{b},{c},5,{n}"] * 2
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_a_file_is_read_from_the_entry_on_and_forecast(tmp_path: Path) -> None:
    tips = tips_of(write(tmp_path / "exp.csv", 0.1))
    assert len(tips) == 101
    assert tips[-1, 2] == pytest.approx(0.1)
    truth = position_at(tips, 0.098)
    assert truth is not None
    np.testing.assert_allclose(truth, [0.098**2 / (2.0 * RADIUS), 0.0], atol=1e-5)
    off, plain, inside = compare(tips, truth)
    assert plain < 1e-5
    assert off < 5e-4
    assert inside


def test_short_or_unsuitable_files_are_left_out(tmp_path: Path) -> None:
    assert position_at(tips_of(write(tmp_path / "exp.csv", 0.09)), 0.098) is None
    (tmp_path / "other.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(UserError, match="expected columns"):
        tips_of(tmp_path / "other.csv")
