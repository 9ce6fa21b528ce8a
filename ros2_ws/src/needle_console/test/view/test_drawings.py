"""Chart, space, dial, views and targets: numbers and pixels where they belong."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from needle_console.view.camera_feed import CameraFeed
from needle_console.view.chart import chart
from needle_console.view.dial import dial
from needle_console.view.overlay import draw_view
from needle_console.view.snapshot import CoursePoint, SeenTip, Snapshot
from needle_console.view.space import (
    ellipsoid,
    plane_centre,
    plane_rotation,
    shaft_points,
    to_view,
)
from needle_console.view.targets import plane_pose, target_point
from needle_core.errors import UserError
from needle_core.files.installed import find_shared
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import RefractedCamera, stereo_views

COVARIANCE = np.diag([4e-8, 1e-8, 9e-8])


def course(*depths: float) -> tuple[CoursePoint, ...]:
    places = [np.array([depth / 20, depth / 40, depth]) for depth in depths]
    return tuple(
        CoursePoint(float(at[2]), float(at[0]) - 0.003, 2e-4, at, COVARIANCE) for at in places
    )


@pytest.fixture(scope="module")
def left() -> RefractedCamera:
    path = find_shared("needle_tracker", "config/calibration.yaml")
    return stereo_views(load_calibration(path))[0]


def decoded(jpeg: bytes) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=float)


def test_shaft_and_tip_are_drawn_where_the_camera_sees_them(left: RefractedCamera) -> None:
    tip = SeenTip(np.array([0.002, 0.001, 0.06]), COVARIANCE, 0.0)
    snapshot = Snapshot(insertion=1.0, tip=tip, course=course(0.02, 0.04))
    black = np.zeros((left.camera.height, left.camera.width), np.uint8)
    picture = decoded(draw_view(black, snapshot, left))
    assert picture.shape == (480, 640, 3)
    scale = 640 / left.camera.width
    for place, blue in ((snapshot.course[0].position, True), (tip.position, False)):
        x, y = np.rint((left.project(place[None])[0] + 0.5) * scale - 0.5).astype(int)
        spot = picture[y - 1 : y + 2, x - 1 : x + 2].mean(axis=(0, 1))
        assert (spot[0] > spot[2]) == blue
        assert spot.max() > 90.0
    far = picture.sum(axis=2)
    assert (far > 60.0).mean() < 0.02


def test_without_a_fitting_calibration_nothing_is_drawn_in(left: RefractedCamera) -> None:
    tip = SeenTip(np.array([0.002, 0.001, 0.06]), COVARIANCE, 0.0)
    snapshot = Snapshot(insertion=1.0, tip=tip, course=course(0.02, 0.04))
    for camera in (None, left):
        picture = decoded(draw_view(np.zeros((480, 640), np.uint8), snapshot, camera))
        assert picture.max() < 10.0


def test_points_that_a_camera_cannot_see_do_no_harm(left: RefractedCamera) -> None:
    tip = SeenTip(np.array([5.0, 5.0, -5.0]), COVARIANCE, 0.0)
    image = np.zeros((left.camera.height, left.camera.width), np.uint8)
    assert draw_view(image, Snapshot(insertion=9.0, tip=tip, course=course(0.1, 4.0)), left)


def test_views_are_drawn_for_who_asks_and_at_most_ten_times_a_second() -> None:
    drawn: list[Snapshot] = []

    def snapshot() -> Snapshot:
        drawn.append(Snapshot())
        return drawn[-1]

    feed = CameraFeed({}, snapshot)
    assert feed.picture("left", 10.0) is None
    feed.put("left", np.zeros((48, 64), np.uint8), 20.0)
    for now in np.arange(20.0, 21.0, 0.01):
        assert feed.picture("left", float(now))
    assert 9 <= len(drawn) <= 10
    assert feed.picture("left", 22.5) is None
    assert feed.picture("right", 20.0) is None


def read(points: str, picture: ElementTree.Element) -> np.ndarray:
    """Return what points of a chart mean [mm], by the numbers along its edges."""
    labels = [(text, float(str(text.text))) for text in picture.iter("text") if is_number(text)]
    below = [(float(text.attrib["x"]), n) for text, n in labels if "middle" in text.attrib.values()]
    # What is written stands 4 below its line.
    beside = [
        (float(text.attrib["y"]) - 4, n) for text, n in labels if "end" in text.attrib.values()
    ]
    assert len(below) > 3 and len(beside) > 3
    x, y = np.array([point.split(",") for point in points.split()], dtype=float).T
    return np.column_stack([on_scale(x, below), on_scale(y, beside)])


def on_scale(values: np.ndarray, marks: list[tuple[float, float]]) -> np.ndarray:
    """Return what places mean on a straight scale with these marks: places, and their numbers."""
    places, numbers = np.transpose(marks)
    return np.asarray(np.polyval(np.polyfit(places, numbers, 1), values))


def is_number(text: ElementTree.Element) -> bool:
    return str(text.text).lstrip("-").replace(".", "", 1).isdigit()


def test_the_chart_has_r1_its_band_and_the_goal_in_mm() -> None:
    picture = ElementTree.fromstring(chart(Snapshot(course=course(0.02, 0.04))))
    (line,), (band,) = picture.iter("polyline"), picture.iter("polygon")
    assert read(line.attrib["points"], picture) == pytest.approx(
        np.array([[20.0, -2.0], [40.0, -1.0]]), abs=0.02
    )
    assert read(band.attrib["points"], picture) == pytest.approx(
        np.array([[20.0, -1.6], [40.0, -0.6], [40.0, -1.4], [20.0, -2.4]]), abs=0.02
    )
    goals = [one.attrib for one in picture.iter("line") if "stroke-dasharray" in one.attrib]
    heights = [read(f"{goal['x1']},{goal['y1']}", picture)[0, 1] for goal in goals]
    assert heights[:2] == pytest.approx([1.0, -1.0], abs=0.02)


@pytest.mark.parametrize("deepest", [0.0005, 0.12, 0.45])
def test_all_of_a_chart_lies_within_its_picture(deepest: float) -> None:
    text = chart(Snapshot(course=course(*np.linspace(1e-4, deepest, 1000))))
    picture = ElementTree.fromstring(text)
    _, _, width, height = map(float, picture.attrib["viewBox"].split())
    for part in picture.iter():
        for point in part.attrib.get("points", "").split():
            x, y = map(float, point.split(","))
            assert 0.0 <= x <= width and 0.0 <= y <= height
    assert "nan" not in chart(Snapshot())


def test_space_keeps_right_handed_axes_and_lengths() -> None:
    axes = to_view(np.eye(3)) / 1e3
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[2] == pytest.approx([1.0, 0.0, 0.0])
    assert axes[0] == pytest.approx([0.0, 0.0, 1.0])


def test_the_ellipsoid_is_two_sigma_of_the_covariance() -> None:
    found = ellipsoid(Snapshot(course=course(0.05)))
    assert found is not None
    centre, half, rotation = found
    assert centre == pytest.approx(to_view(course(0.05)[0].position))
    assert sorted(half) == pytest.approx([0.2, 0.4, 0.6])
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    spread = rotation @ np.diag(half**2) @ rotation.T
    # Along the insertion, the view's x, sigma is 0.3 mm; upwards, its z, 0.2 mm.
    assert np.sqrt(np.diag(spread)) == pytest.approx([0.6, 0.2, 0.4])
    assert ellipsoid(Snapshot()) is None


def test_the_shaft_is_drawn_from_the_entry_to_the_tip() -> None:
    depths = np.arange(0.0005, 0.02, 0.0005)
    snapshot = Snapshot(insertion=0.015, course=course(*depths))
    points = shaft_points(snapshot)
    assert points[0] == pytest.approx([0.0, 0.0, 0.0])
    assert points[-1][0] == pytest.approx(15.0)
    assert len(points) < 12
    assert len(shaft_points(Snapshot())) == 1


def test_a_tilted_plane_lies_where_it_was_asked_for() -> None:
    pose = plane_pose(4.0, 30.0)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    snapshot = Snapshot(T_rig_plane=pose)
    normal = plane_rotation(snapshot)[:, 2]
    assert normal == pytest.approx(to_view(pose[:3, 0]) / 1e3)
    # 4 mm above the entry along the normal, also at the centre of what is drawn.
    assert normal @ plane_centre(snapshot, 0.12) == pytest.approx(4.0)
    # It rises inwards.
    assert plane_centre(snapshot, 0.12)[2] > 4.0


@pytest.mark.parametrize("wrong", [(math.nan, 0.0), (51.0, 0.0), (0.0, 46.0), (0.0, math.inf)])
def test_a_plane_out_of_bounds_is_refused(wrong: tuple[float, float]) -> None:
    with pytest.raises(UserError):
        plane_pose(*wrong)


def test_a_point_out_of_bounds_is_refused() -> None:
    assert target_point(10.0, -5.0, 100.0) == pytest.approx([0.01, -0.005, 0.1])
    for wrong in ((151.0, 0.0, 50.0), (0.0, 0.0, 0.0), (0.0, math.nan, 50.0)):
        with pytest.raises(UserError):
            target_point(*wrong)


def test_the_dial_points_up_at_0_and_to_the_right_after_a_quarter_turn() -> None:
    assert 'x2="24.00" y2="6.00"' in dial(0.0)
    assert 'x2="42.00" y2="24.00"' in dial(math.pi / 2)
    assert "#0072b2" not in dial(math.nan)
