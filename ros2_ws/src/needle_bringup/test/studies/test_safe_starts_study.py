"""The study of safe starts, on a coarse grid."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from needle_bringup.studies import safe_starts_study
from needle_bringup.studies.safe_starts_study import main


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safe_starts_study, "OFFSETS", np.linspace(-0.01, 0.01, 3))
    monkeypatch.setattr(safe_starts_study, "ANGLES", np.radians([-4.0, 0.0, 4.0]))


def test_it_writes_figures_and_a_picture(tmp_path: Path) -> None:
    picture, figures = tmp_path / "a.png", tmp_path / "a.json"
    words = ["--target", "-2,0,90", "--output", str(picture), "--json", str(figures)]
    assert main(words) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    seen = json.loads(figures.read_text(encoding="utf-8"))
    assert seen["safe_shift_mm"] == pytest.approx(10.0)
    assert seen["shifted_share"] == 1.0


def test_an_entry_that_is_not_safe_is_exit_code_1(tmp_path: Path) -> None:
    file = tmp_path / "o.yaml"
    file.write_text("frame: rig\nspheres: [{center: [0.0, 0.0, 0.005], radius: 0.004}]\n", "utf-8")
    assert main(["--target", "0,0,90", "--obstacles", str(file)]) == 1


def test_bad_targets_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (([], "is missing"), (["1,2"], "X_MM,Y_MM,Z_MM"), (["a,2,3"], "'a'")):
        assert main([*(["--target"] if words else []), *words]) == 2
        assert said in capsys.readouterr().err
