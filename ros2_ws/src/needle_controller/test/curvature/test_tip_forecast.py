from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from needle_controller.curvature import tip_forecast
from needle_controller.curvature.curvature_checks import fit_checked
from needle_controller.curvature.curvature_fit import CurvatureFitSettings
from needle_controller.curvature.identify_curvature import main
from needle_controller.curvature.tip_forecast import forecast_tip
from needle_controller.model.arrays import Array

SEEN, AHEAD, NOISE = 0.050, 0.098, 1e-4
HEADING_STD = math.radians(5.0)
INSERTION = np.arange(0.0, SEEN + 1e-9, 0.001)


def arc(radius: float, length: Array) -> Array:
    turned = length / radius
    return np.stack(
        [radius * (1.0 - np.cos(turned)), 0.0 * length, radius * np.sin(turned)], axis=-1
    )


@pytest.mark.parametrize("insertion_known", [True, False])
@pytest.mark.parametrize("radius", [0.122, 0.5, 3.0])
def test_an_arc_is_continued(radius: float, insertion_known: bool) -> None:
    noise = np.random.default_rng(4).normal(0.0, NOISE, (len(INSERTION), 3))
    tips = arc(radius, INSERTION) + noise
    fit = fit_checked(tips, INSERTION if insertion_known else None, CurvatureFitSettings())
    tip, interval = forecast_tip(tips, fit, AHEAD)
    off = np.abs(tip - arc(radius, np.array(AHEAD)))
    assert np.all(off <= 1.3 * interval + 1e-5)
    # The forecast is limited by the tissue, and better than a parabola.
    assert 3e-4 < interval[1] < 3e-3


def test_the_forecast_of_a_straight_needle_is_gaussian_process_regression(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Compare with the same model in the form of covariances between positions."""
    scale = 0.3
    monkeypatch.setattr(tip_forecast, "SCALES", np.array([scale]))
    settings = CurvatureFitSettings(slip_std=1e-6)
    # The needle moves so little aside that the sine of its heading equals the heading.
    bends = np.random.default_rng(5).normal(0.0, 1e-6, (len(INSERTION), 2))
    seen = np.column_stack([np.cumsum(np.cumsum(bends, axis=0), axis=0), INSERTION])
    fit = fit_checked(seen, INSERTION, settings)
    # Known noise, no outliers.
    fit = dataclasses.replace(fit, measurement_std=np.array(NOISE), weights=np.ones(len(INSERTION)))
    tip, interval = forecast_tip(seen, fit, AHEAD)
    places = np.append(INSERTION, AHEAD)
    cells = np.arange(0.0005, AHEAD, 0.001)
    moved = np.maximum(places[:, None] - cells, 0.0) * 0.001
    apart = np.abs(np.subtract.outer(cells, cells)) / tip_forecast.LOCAL_LENGTH
    whole = moved @ (tip_forecast.LOCAL_SPREAD**2 * np.exp(-apart)) @ moved.T
    whole += settings.entry_std**2 + HEADING_STD**2 * np.outer(places, places)
    whole += scale**2 * np.outer(places**2, places**2) / 4.0
    known = whole[:-1, :-1] + NOISE**2 * np.eye(len(INSERTION))
    gain = np.linalg.solve(known, whole[:-1, -1])
    np.testing.assert_allclose(tip[:2], gain @ seen[:, :2], atol=5e-6)
    spread = math.sqrt(whole[-1, -1] - gain @ whole[:-1, -1])
    np.testing.assert_allclose(interval[:2], 1.96 * spread, rtol=0.01)


def test_the_command_prints_the_forecast(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(4).normal(0.0, NOISE, (len(INSERTION), 3))
    table = np.column_stack([INSERTION, arc(3.0, INSERTION) + noise, 0.0 * INSERTION])
    path, result = tmp_path / "tips.csv", tmp_path / "result.json"
    header = "insertion_m,x_m,y_m,z_m,rotation_rad"
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    assert main([str(path), "--json", str(result), "--forecast-mm", "98"]) == 0
    values = json.loads(result.read_text(encoding="utf-8"))
    printed = f"at 98 mm the tip will be at x = {values['forecast_x_mm']:.2f}"
    assert printed in capsys.readouterr().out
    for name, wanted in zip("xyz", 1e3 * arc(3.0, np.array(AHEAD)), strict=True):
        interval = values[f"forecast_{name}_95_mm"]
        assert values[f"forecast_{name}_mm"] == pytest.approx(wanted, abs=interval)
