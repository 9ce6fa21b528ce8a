"""Registrations of simulated points: errors as claimed, and a named reason for each mistake."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_core.errors import UserError
from needle_tracker.tracked import register_tracker
from needle_tracker.tracked.register_tracker import pivot, register
from needle_tracker.tracked.registration import read_registration

NAMES = list("ABCDEF")
RIG = 1e-3 * np.array(
    [[17, -40, -10], [17, 35, 5], [17, -20, 120], [17, 50, 90], [-15, 10, 60], [30, -45, 45]]
)
TURN = Rotation.from_euler("xyz", (2.0, -0.4, 1.1))
PLACE = np.array([0.21, -0.33, 0.28])
FLE = 0.3e-3
"""Standard deviation of a measured coordinate [m]."""


def measured(rig: np.ndarray, seed: int = 1, noise: float = FLE) -> Any:
    random = np.random.default_rng(seed)
    return TURN.inv().apply(rig - PLACE) + random.normal(0.0, noise, rig.shape)


def test_the_claimed_error_is_that_of_many_registrations() -> None:
    """Errors inside and outside the points; the leave-one-out error is a target error."""
    places = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.12], [0.0, 0.1, 0.3]])
    squares, inside, left_out = [], [], []
    for seed in range(30):
        found, _, errors = register(NAMES, RIG, measured(RIG, seed))
        for place in places:
            pose = found.T_rig_tracker
            error = pose[:3, :3] @ TURN.inv().apply(place - PLACE) + pose[:3, 3] - place
            covariance = found.covariance_at(place)
            squares.append([error @ error, np.trace(covariance)])
            inside.append(error @ np.linalg.solve(covariance, error) < 14.16)
        left_out.append(np.mean(errors**2))
    true, claimed = np.mean(squares, axis=0)
    # By Student's t with 12 degrees of freedom, the claim is 12 / 10 of the mean.
    assert claimed / true == pytest.approx(1.2, rel=0.2)
    assert np.mean(inside) > 0.98
    # The error of a left-out point itself is added.
    assert math.sqrt(np.mean(left_out)) > math.sqrt(3.0) * FLE


def only(*rig: tuple[float, float, float]) -> Callable[[np.ndarray, np.ndarray], Any]:
    """Return points at these places in `rig` [mm]."""
    points = 1e-3 * np.array(rig)
    return lambda *_: (points, measured(points))


BAD_POINTS: dict[str, tuple[Callable[[Any, Any], Any], str]] = {
    "two points": (lambda r, t: (r[:2], t[:2]), "number of points = 2 is outside [3, inf]"),
    "on a line": (only((0, 0, 0), (1, 0, 50), (0, 1, 100), (0, 0, 140)), "rig are within 0"),
    "same measurement": (
        lambda r, t: (r, t[[0, 0, 2, 3, 4, 5]]),
        "distance of A and B in tracker = 0 mm",
    ),
    "square": (
        only((0, 0, 0), (0, 50, 0), (0, 50, 50), (0, 0, 50)),
        "an exchange of A and C would not be noticed",
    ),
    "A and B swapped": (lambda r, t: (r, t[[1, 0, 2, 3, 4, 5]]), "A and B are exchanged"),
    "rotated list": (lambda r, t: (r, np.roll(t, 1, axis=0)), "the points do not fit"),
    "mirrored": (lambda r, t: (r, t * [1, 1, -1]), "an axis of the tracker is mirrored"),
    "micrometres": (lambda r, t: (r, 1e3 * t), "outside [-10000, 10000]"),
    "inches": (lambda r, t: (r, t / 25.4 * 10.0), "distances in tracker are 0.39"),
    "5 mm off": (
        lambda r, t: (r, t + np.outer(np.eye(6)[4], [0.0, 0.0, 5e-3])),
        "E does not fit the others",
    ),
    # Three points leave no error at a point left out.
    "one of three off": (
        lambda r, t: (r[:3], t[:3] + np.outer(np.eye(3)[2], [0.0, 0.0, 8e-3])),
        "fiducial error",
    ),
    "far away": (
        only((0, 0, -3000), (0, 20, -3000), (20, 0, -3020)),
        "standard deviation at the entry point",
    ),
}


@pytest.mark.parametrize("case", BAD_POINTS)
def test_bad_points_are_refused_by_name(case: str, tmp_path: Path, monkeypatch: Any) -> None:
    change, text = BAD_POINTS[case]
    with pytest.raises(UserError) as error:
        run(tmp_path, monkeypatch, *change(RIG, measured(RIG)))
    assert text in str(error.value)
    assert not (tmp_path / "out.yaml").exists()


def run(tmp_path: Path, monkeypatch: Any, rig: np.ndarray, tracker: np.ndarray, *more: str) -> Any:
    """Run the command on points [m], and return its JSON."""
    header = "name," + ",".join(f"{f}_{a}_mm" for f in ("rig", "tracker") for a in "xyz")
    rows = [
        f"{n},{','.join(map(str, 1e3 * p))}"
        for n, p in zip(NAMES, np.hstack([rig, tracker]), strict=False)
    ]
    (tmp_path / "points.csv").write_text("\n".join([header, *rows]))
    out, json_file = tmp_path / "out.yaml", tmp_path / "out.json"
    arguments = [tmp_path / "points.csv", "--output", out, "--json", json_file, *more]
    monkeypatch.setattr("sys.argv", ["register_tracker", *map(str, arguments)])
    assert register_tracker._main() == 0
    return json.loads(json_file.read_text())


def poses(offset: np.ndarray, angle: float, noise: float, count: int = 30) -> np.ndarray:
    """Return poses [m] of a sensor that turns up to an angle [rad] about its tip."""
    random = np.random.default_rng(3)
    turns = Rotation.from_rotvec(random.uniform(-angle, angle, (count, 3)))
    places = np.array([0.1, 0.2, 0.3]) - turns.apply(offset) + random.normal(0, noise, (count, 3))
    return np.hstack([places, turns.as_quat()])


def test_file_of_points_and_pivot(tmp_path: Path, monkeypatch: Any) -> None:
    offset = np.array([2e-3, -1e-3, 0.15])
    table = poses(offset, 0.5, FLE) * [1e3, 1e3, 1e3, 1, 1, 1, 1]
    np.savetxt(
        tmp_path / "p.csv", table, delimiter=",", header="x_mm,y_mm,z_mm,qx,qy,qz,qw", comments=""
    )
    values = run(tmp_path, monkeypatch, RIG, measured(RIG), "--pivot", str(tmp_path / "p.csv"))
    found = read_registration(tmp_path / "out.yaml")
    np.testing.assert_allclose(found.tip_offset, offset, atol=0.4e-3)
    assert found.sensor_std == pytest.approx(FLE, rel=0.2)
    np.testing.assert_allclose(found.T_rig_tracker[:3, :3], TURN.as_matrix(), atol=0.01)
    assert values["points"] == 6
    assert 0.1 < values["fiducial_error_mm"] < values["target_error_mm"] < 2.0
    assert values["std_at_entry_mm"] == pytest.approx(1e3 * found.std_at(np.zeros(3)))


@pytest.mark.parametrize(
    ("table", "text"),
    [
        (poses(np.array([0, 0, 0.1]), 0.5, 0.0, 5), "number of poses in --pivot = 5"),
        (poses(np.array([0, 0, 0.1]), 0.02, FLE), "turned too little"),
        (poses(np.array([0, 0, 0.1]), 0.5, 2e-3), "the tip moved by"),
        (poses(np.array([0, 0, 0.1]), 0.5, 0.0) * 1.1, "norm of a quaternion"),
    ],
)
def test_bad_pivot_is_refused_by_name(table: np.ndarray, text: str) -> None:
    with pytest.raises(UserError, match=text):
        pivot(table[:, :3], table[:, 3:])


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("T_rig_tracker", None, "not YAML"),
        ("sensor_std", "sensor_std: 0.0", "sensor_std = 0 m is outside"),
        ("centroid", "centroid: [0, 0]", "centroid needs 3 numbers"),
        ("tip_offset", "tip_offset: [0, 0, 150]", "length of tip_offset = 150 m"),
        ("  rotation", "  rotation: [0, 0, 0, 0]", "norm of T_rig_tracker.rotation = 0"),
        ("  translation", "  translation: [210, -330, 280]", "translation = "),
    ],
)
def test_bad_file_is_refused_by_name(
    key: str, value: str | None, text: str, tmp_path: Path, monkeypatch: Any
) -> None:
    run(tmp_path, monkeypatch, RIG, measured(RIG))
    path = tmp_path / "out.yaml"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(value or "" if line.startswith(key) else line for line in lines))
    with pytest.raises(UserError, match=text):
        read_registration(path)
