"""Chart, dial, 3D view, camera views and targets."""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from needle_console.view.camera_view import CameraView, draw_view
from needle_console.view.drawings import chart, dial
from needle_console.view.snapshot import MeasuredTip, Snapshot, TrackPoint
from needle_console.view.space import ellipsoid, plane_centre, plane_rotation, shaft_points, to_view
from needle_console.view.targets import plane_pose, target_point
from needle_core.errors import UserError
from needle_core.status_messages import ControllerStatus

COVARIANCE = np.diag([4e-8, 1e-8, 9e-8])
TIP = MeasuredTip(np.array([0.002, 0.001, 0.06]), COVARIANCE, 0.0)


def track(*depths: float) -> tuple[TrackPoint, ...]:
    places = [np.array([depth / 20, depth / 40, depth]) for depth in depths]
    return tuple(
        TrackPoint(float(at[2]), float(at[0]) - 0.003, 2e-4, at, COVARIANCE) for at in places
    )


class Camera:
    """Projects x upwards and z to the right; points behind the entry are invisible."""

    def __init__(self) -> None:
        self.camera, self.width, self.height = self, 1280, 960

    def project(self, points: np.ndarray) -> np.ndarray:
        u, v = 100.0 + 8000.0 * points[:, 2], 480.0 - 8000.0 * points[:, 0]
        return np.column_stack([np.where(u < 0.0, math.nan, u), v])


def view(snapshot: Snapshot, camera: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the drawing in a black image of a size (height, width)."""
    jpeg = draw_view(np.zeros(size, np.uint8), snapshot, camera)
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=float)


def test_shaft_tip_and_target_are_drawn_at_their_pixels() -> None:
    camera, size = Camera(), (960, 1280)
    target = (-0.01, 0.0, 0.08)
    controller = ControllerStatus(target_point_m=target)
    snapshot = Snapshot(None, controller, insertion=1.0, tip=TIP, track=track(0.02, 0.04))
    picture = view(snapshot, camera, size)
    assert picture.shape == (480, 640, 3)
    # A diamond is drawn around its point, the other marks on it.
    for place, reach, is_blue in (
        (snapshot.track[0].position, 1, True),
        (TIP.position, 1, False),
        (np.array(target), 9, False),
    ):
        x, y = np.rint((camera.project(place[None])[0] + 0.5) * 0.5 - 0.5).astype(int)
        spot = picture[y - reach : y + reach + 1, x - reach : x + reach + 1]
        blue, _, red = spot.mean(axis=(0, 1))
        assert (blue > red) == is_blue
        assert spot.max() > 90.0
    assert (picture.sum(axis=2) > 60.0).mean() < 0.02
    # Invisible points do no harm. Without a matching calibration nothing is drawn.
    beyond = MeasuredTip(np.array([5.0, 5.0, -5.0]), COVARIANCE, 0.0)
    view(Snapshot(insertion=9.0, tip=beyond, track=track(0.1, 4.0)), camera, size)
    for unfit in (None, camera):
        assert view(snapshot, unfit, (480, 640)).max() < 10.0


def test_views_are_drawn_at_most_ten_times_per_second() -> None:
    drawn: list[Snapshot] = []

    def snapshot() -> Snapshot:
        drawn.append(Snapshot())
        return drawn[-1]

    view = CameraView({}, snapshot)
    assert view.jpeg("left", 10.0) is None
    view.set_image("left", np.zeros((48, 64), np.uint8), 20.0)
    for now in np.arange(20.0, 21.0, 0.01):
        assert view.jpeg("left", float(now))
    assert 9 <= len(drawn) <= 10
    assert view.jpeg("left", 22.5) is None
    assert view.jpeg("right", 20.0) is None


def read(points: str, picture: ElementTree.Element) -> np.ndarray:
    """Return the values of points in a chart [mm], by its axis labels."""
    marks = [
        (text.attrib, float(str(text.text)))
        for text in picture.iter("text")
        if str(text.text).lstrip("-").replace(".", "", 1).isdigit()
    ]
    below = [(float(at["x"]), n) for at, n in marks if at["text-anchor"] == "middle"]
    # Labels are 4 px below their lines.
    beside = [(float(at["y"]) - 4, n) for at, n in marks if at["text-anchor"] == "end"]
    assert len(below) > 3 and len(beside) > 3
    places = np.array([point.split(",") for point in points.split()], dtype=float).T
    scales = [np.polyfit([at for at, _ in a], [n for _, n in a], 1) for a in (below, beside)]
    return np.column_stack([np.polyval(s, p) for s, p in zip(scales, places, strict=True)])


def test_chart_shows_r1_sigma_and_goal_in_mm() -> None:
    picture = ElementTree.fromstring(chart(Snapshot(track=track(0.02, 0.04))))
    (line,), (band,) = picture.iter("polyline"), picture.iter("polygon")
    for points, meant in (
        (line.attrib["points"], [[20.0, -2.0], [40.0, -1.0]]),
        (band.attrib["points"], [[20.0, -1.6], [40.0, -0.6], [40.0, -1.4], [20.0, -2.4]]),
    ):
        assert read(points, picture) == pytest.approx(np.array(meant), abs=0.02)
    goals = [one.attrib for one in picture.iter("line") if "stroke-dasharray" in one.attrib]
    heights = [read(f"{goal['x1']},{goal['y1']}", picture)[0, 1] for goal in goals]
    assert heights[:2] == pytest.approx([1.0, -1.0], abs=0.02)


@pytest.mark.parametrize("deepest", [0.0005, 0.12, 0.45])
def test_chart_stays_within_its_frame(deepest: float) -> None:
    text = chart(Snapshot(track=track(*np.linspace(1e-4, deepest, 50))))
    picture = ElementTree.fromstring(text)
    _, _, width, height = map(float, picture.attrib["viewBox"].split())
    points = [point for part in picture.iter() for point in part.attrib.get("points", "").split()]
    assert len(points) > 100
    for point in points:
        x, y = map(float, point.split(","))
        assert 0.0 <= x <= width and 0.0 <= y <= height
    assert "nan" not in chart(Snapshot())


def test_view_transform_is_a_rotation_in_mm() -> None:
    axes = to_view(np.eye(3)) / 1e3
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[2] == pytest.approx([1.0, 0.0, 0.0])
    assert axes[0] == pytest.approx([0.0, 0.0, 1.0])


def test_ellipsoid_is_two_sigma() -> None:
    assert ellipsoid(Snapshot()) is None
    for snapshot, place in (
        (Snapshot(track=track(0.05), tip=TIP), track(0.05)[0].position),
        (Snapshot(tip=TIP), TIP.position),
    ):
        found = ellipsoid(snapshot)
        assert found is not None
        centre, half, rotation = found
        assert centre == pytest.approx(to_view(place))
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        spread = rotation @ np.diag(half**2) @ rotation.T
        # Along the insertion, the view's x, sigma is 0.3 mm; upwards, its z, 0.2 mm.
        assert np.sqrt(np.diag(spread)) == pytest.approx([0.6, 0.2, 0.4])


def test_shaft_reaches_from_entry_to_tip() -> None:
    snapshot = Snapshot(insertion=0.015, track=track(*np.arange(0.0005, 0.02, 0.0005)))
    points = shaft_points(snapshot)
    assert points[0] == pytest.approx([0.0, 0.0, 0.0])
    assert points[-1][0] == pytest.approx(15.0)
    assert len(points) < 12
    assert len(shaft_points(Snapshot())) == 1


def test_tilted_plane_position() -> None:
    pose = plane_pose(4.0, 30.0)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    snapshot = Snapshot(T_rig_plane=pose)
    normal = plane_rotation(snapshot)[:, 2]
    assert normal == pytest.approx(to_view(pose[:3, 0]) / 1e3)
    # 4 mm above the entry along the normal, also at the centre of what is drawn.
    assert normal @ plane_centre(snapshot, 0.12) == pytest.approx(4.0)
    # It rises inwards.
    assert plane_centre(snapshot, 0.12)[2] > 4.0


def test_target_out_of_bounds_is_refused() -> None:
    for plane in ((math.nan, 0.0), (-50.1, 0.0), (0.0, 45.1)):
        with pytest.raises(UserError):
            plane_pose(*plane)
    for point in ((150.1, 0.0, 50.0), (0.0, -150.1, 50.0), (0.0, 0.0, 0.9)):
        with pytest.raises(UserError):
            target_point(*point)


def test_dial_pointer_direction() -> None:
    assert 'x2="24.00" y2="6.00"' in dial(0.0)
    assert 'x2="42.00" y2="24.00"' in dial(math.pi / 2)
    assert "#0072b2" not in dial(math.nan)
