"""The component of the tracker, called directly: messages in; answers, health and logs out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drawn_needles import arc
from needle_core import messages as m
from needle_core.component import Actions, Diagnose, Log, Moment, Peers, Publish
from needle_core.diagnostics import Level
from needle_core.errors import UserError
from needle_tracker.answers.tracker_messages import camera_info_problem, image_geometry
from needle_tracker.detector.search_grid import SearchGrid, make_search_grid
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.optics.calibration import Camera, StereoCalibration
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.stereo_tracker import StereoTipTracker, make_tracker
from needle_tracker.tracker_parameters import StereoTrackerParameters

PIXELS = np.zeros((768, 1024), np.uint8)
FOUND = Measurement(
    SpatialTip(np.array([0.001, 0.002, 0.05]), 1e-8 * np.eye(3), np.eye(3)[2], np.zeros((3, 3))),
    TrackState.TRACKING,
    "",
)
NOT_FOUND = Measurement(None, TrackState.SEARCHING, "no needle")
SECOND = 1_000_000_000


class Bench:
    """The component, its input, and its last output."""

    def __init__(self, tracker: StereoTipTracker) -> None:
        self.tracker, self.now = tracker, 0.0
        self.handlers = {row.topic: row.handler for row in tracker.inputs}
        self.sent: dict[str, list[Any]] = {output.topic: [] for output in tracker.outputs}
        self.health: dict[str, Any] = {}
        self.logs: list[str] = []
        self.measured: Measurement | None = FOUND
        process = tracker.answers.tracker.process
        tracker.answers.tracker.process = (  # type: ignore[method-assign]
            lambda *pair: self.measured or process(*pair)
        )
        tracker.answers.swap.update = lambda *_: None  # type: ignore[method-assign]

    def do(self, actions: Actions) -> None:
        for action in actions:
            if isinstance(action, Publish):
                self.sent[action.topic].append(action.message)
            elif isinstance(action, Diagnose):
                self.health[action.part] = action.diagnostic
            elif isinstance(action, Log):
                self.logs.append(action.text)

    def receive(self, topic: str, message: Any) -> None:
        self.do(self.handlers[topic](message, Moment(self.now, 0)))

    def check(self, now: float = 0.0) -> None:
        self.now = now
        self.do(self.tracker.check(Moment(now, 0)))

    def joints(self, stamp: int, insertion: float = 0.05, name: str = "insertion_joint") -> None:
        self.receive("joint_states", m.JointState(stamp, (name,), (insertion,)))

    def image(self, side: str, stamp: int, pixels: Any = PIXELS, **fields: Any) -> None:
        height, width = pixels.shape
        data = pixels.tobytes()
        image = m.Image(stamp, "", height, width, "mono8", width, data)
        self.receive(f"stereo/{side}/image_raw", dataclasses.replace(image, **fields))

    def pair(self, stamp: int, left: Any = PIXELS, right: Any = PIXELS, **fields: Any) -> bool:
        """Send a joint state and a pair; return whether the answer is a tip."""
        answers = len(self.sent["needle/tip_pose"])
        self.joints(stamp)
        self.image("left", stamp, left)
        self.image("right", stamp, right, **fields)
        (pose,) = self.sent["needle/tip_pose"][answers:]
        diagonal = np.reshape(pose.covariance, (6, 6)).diagonal()
        assert np.all(np.isfinite(diagonal)) or np.all(np.isinf(diagonal))
        return bool(np.all(np.isfinite(diagonal)))

    def reported(self, part: str) -> tuple[Level, str]:
        return self.health[part].level, self.health[part].message


Make = Callable[..., Bench]


@pytest.fixture(scope="module")
def search_grid(views: tuple[RefractedCamera, RefractedCamera]) -> SearchGrid:
    """Return the grid that all trackers of these tests share; to make it takes some time."""
    return make_search_grid(views, StereoTrackerParameters())


@pytest.fixture
def make(
    calibration: StereoCalibration, search_grid: SearchGrid, monkeypatch: pytest.MonkeyPatch
) -> Make:
    monkeypatch.setattr(
        "needle_tracker.filter.needle_tracker.NeedleTracker.warm_up", lambda _: None
    )

    def make(**parameters: Any) -> Bench:
        settings = StereoTrackerParameters(**parameters)
        with_text = dataclasses.replace(calibration, text="text of the file")
        return Bench(StereoTipTracker(settings, with_text))

    return make


@pytest.fixture
def bench(make: Make) -> Bench:
    return make()


def test_a_pair_gives_tip_and_pose_with_the_stamp_of_the_exposure(
    bench: Bench, draw_pair: Any
) -> None:
    bench.measured = None
    path = arc(0.05, 5.0, 1.0)
    assert bench.pair(SECOND + 20, *draw_pair(path))
    (tip,), (pose,) = bench.sent["needle/tip"], bench.sent["needle/tip_pose"]
    assert (tip.frame_id, pose.frame_id) == ("rig", "rig")
    assert tip.stamp_ns == pose.stamp_ns == SECOND + 20
    np.testing.assert_allclose(tip.position, path[-1], atol=0.3e-3)
    assert tip.position == pose.position
    covariance = np.reshape(pose.covariance, (6, 6))
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(covariance) > -1e-15)
    assert covariance[:3, :3].trace() < 1e-6
    assert bench.reported("track") == (Level.OK, "TRACKING")
    assert bench.reported("images") == (Level.OK, "pairs complete")
    assert bench.reported("joints") == (Level.OK, "insertion known")
    assert not bench.logs


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"encoding": "rgb8"}, "right image has 786432 bytes in rows of 1024"),
        ({"encoding": "mono16"}, "right image is 'mono16', expected 8 bits, such as mono8"),
        ({"width": 640}, "right image is 640x768, the calibration is for 1024x768"),
        ({"data": PIXELS.tobytes()[1:]}, "right image has 786431 bytes in rows of 1024"),
    ],
)
def test_bad_images_give_no_tip_and_are_reported(
    bench: Bench, fields: dict[str, Any], reason: str
) -> None:
    assert not bench.pair(10, **fields)
    level, message = bench.reported("images")
    assert level is Level.ERROR
    assert message.startswith(f"pair refused: {reason}")
    assert bench.health["images"].values["pairs_refused"] == "1"
    assert bench.logs.count(f"images: {message}") == 1
    assert not bench.sent["needle/tip"]
    assert bench.pair(20)
    bench.check(6.0)
    assert bench.reported("images") == (Level.OK, "pairs complete")


def test_time_running_backwards_gives_no_tip(bench: Bench) -> None:
    assert bench.pair(5 * SECOND)
    assert not bench.pair(5 * SECOND - 1000)
    assert "ran backwards" in bench.reported("images")[1]
    assert not bench.pair(5 * SECOND)
    assert "repeated" in bench.reported("images")[1]
    assert bench.pair(5 * SECOND + 1000)
    # A large step back is a new recording: its first pair is rejected, the next processed.
    assert not bench.pair(SECOND)
    assert bench.pair(SECOND + 1000)


def info(camera: Camera, fields: dict[str, Any]) -> m.CameraInfo:
    """Return the message of a sensor, with an roi (x, y, width, height) and binning."""
    x, y, width, height = fields.get("roi", (0, 0, 0, 0))
    message = m.CameraInfo(0, "", camera.height, camera.width, "plumb_bob", (), (), (), ())
    roi = m.RegionOfInterest(x, y, width, height)
    bins = {key: value for key, value in fields.items() if key != "roi"}
    k = tuple(camera.camera_matrix.ravel().tolist())
    return dataclasses.replace(message, k=k, roi=roi, **bins)


def test_region_and_binning_of_camera_info_are_applied(calibration: StereoCalibration) -> None:
    K = np.array([[4000.0, 3.0, 1030.0], [0.0, 4020.0, 765.0], [0.0, 0.0, 1.0]])
    sensor = dataclasses.replace(calibration.left, width=2048, height=1536, camera_matrix=K)
    ray = np.array([0.05, -0.03, 1.0])
    for roi, bins, size in (
        ((0, 0, 0, 0), (0, 0), (2048, 1536)),
        ((0, 0, 0, 0), (3, 2), (682, 768)),
        ((512, 384, 1024, 768), (2, 4), (512, 192)),
        ((100, 0, 1900, 0), (2, 1), (950, 1536)),
    ):
        message = info(sensor, {"roi": roi, "binning_x": bins[0], "binning_y": bins[1]})
        width, height, matrix = image_geometry(message)
        assert (width, height) == size
        expected = ((K @ ray)[:2] - roi[:2]) / np.maximum(bins, 1)
        np.testing.assert_allclose((matrix @ ray)[:2], expected)
        shown = dataclasses.replace(sensor, width=width, height=height, camera_matrix=matrix)
        assert camera_info_problem(message, "left", shown) == ("", False)
        matrix[0, 2] += 0.6
        wanted = "left camera_info differs from the calibration by 0.6 px"
        assert camera_info_problem(message, "left", shown) == (wanted, False)


def test_a_camera_that_runs_at_another_resolution_gives_no_tip(
    bench: Bench, calibration: StereoCalibration
) -> None:
    topic, camera = "stereo/left/camera_info", calibration.left
    sensor = dataclasses.replace(camera, width=2048, height=1536, camera_matrix=np.zeros((3, 3)))
    bench.receive(topic, info(sensor, {"binning_x": 4, "binning_y": 2}))
    bench.check()
    reason = "left camera_info is for 512x768"
    assert bench.reported("images") == (Level.ERROR, f"{reason}, the calibration for 1024x768")
    assert not bench.pair(10)
    assert bench.reported("images")[1].startswith(f"pair refused: {reason}")
    # A sensor larger than its images, and a driver without data, are no contradiction.
    unknown = dataclasses.replace(sensor, width=0, height=0)
    for number, message in enumerate(
        (info(sensor, {"binning_x": 2, "binning_y": 2}), info(unknown, {}))
    ):
        bench.receive(topic, message)
        assert bench.pair(20 + number)


def test_images_without_a_partner_are_reported(bench: Bench) -> None:
    bench.check()
    assert bench.reported("images") == (Level.WARN, "no images yet")
    bench.image("left", 1)
    bench.check(0.6)
    assert bench.reported("images") == (Level.WARN, "left images without right")
    for stamp in range(2, 6):
        bench.image("left", stamp)
    bench.image("right", 99)
    bench.check(0.7)
    assert bench.reported("images") == (Level.WARN, "images without a partner were dropped")
    values = bench.health["images"].values
    assert (values["left_without_right"], values["pairs"]) == ("2", "0")
    assert not bench.sent["needle/tip_pose"]


def test_useless_joint_states_are_counted_and_silence_is_a_warning(bench: Bench) -> None:
    bench.joints(1, name="rotation_joint")
    bench.joints(1, math.nan)
    bench.check()
    assert bench.reported("joints") == (Level.OK, "no joint states yet")
    bench.image("left", 5)
    bench.image("right", 5)
    assert not bench.sent["needle/tip_pose"]
    bench.check(1.0)
    assert len(bench.sent["needle/tip_pose"]) == 1
    assert bench.reported("joints")[0] is Level.WARN
    values = bench.health["joints"].values
    assert (values["without_insertion_joint"], values["not_finite"]) == ("1", "1")
    bench.joints(10)
    bench.check(1.0)
    assert bench.reported("joints") == (Level.OK, "insertion known")


def test_images_stamped_by_another_clock_than_joint_states_are_a_warning(bench: Bench) -> None:
    bench.joints(10 * SECOND)
    for stamp, expected in (
        (9 * SECOND, (Level.OK, "insertion known")),
        (9 * SECOND - 1, (Level.WARN, "no pair is processed: exposed 1.0 s before the first")),
    ):
        bench.image("left", stamp)
        bench.image("right", stamp)
        bench.check()
        level, message = bench.reported("joints")
        assert (level, message[: len(expected[1])]) == expected
    assert bench.health["joints"].values["pairs_before_joint_states"] == "2"
    assert not bench.sent["needle/tip_pose"]
    assert bench.pair(11 * SECOND)
    assert bench.reported("joints") == (Level.OK, "insertion known")


def test_swapped_images_are_a_warning(bench: Bench) -> None:
    bench.measured = NOT_FOUND
    bench.tracker.answers.swap.suspected = True
    assert not bench.pair(10)
    level, message = bench.reported("images")
    assert level is Level.WARN
    assert "seem to be swapped" in message
    assert "parameters left and right" in message
    # An unchanged state is not logged again.
    bench.check(0.1)
    assert sum("seem to be swapped" in text for text in bench.logs) == 1


def test_pictures_are_drawn_for_subscribers_at_a_limited_rate(make: Make) -> None:
    bench = make(annotated_rate=2.0)
    topic = "stereo_tracker/annotated_image"
    bench.pair(1)
    assert not bench.sent[topic]
    list(bench.tracker.on_peers(Peers(subscribers={topic: ("viewer",)}), Moment(0.0, 0)))
    for stamp, bench.now, pictures in ((2, 0.0, 1), (3, 0.4, 1), (4, 0.5, 2)):
        bench.pair(stamp)
        assert len(bench.sent[topic]) == pictures
    bench.check()
    bench.check()
    assert bench.sent["stereo_tracker/calibration"] == [m.Text("text of the file")]


def test_bad_parameters_are_rejected_and_the_installed_calibration_is_the_default(
    calibration_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value, cause in (
        ("calibration_file", "/nowhere/rig.yaml", "/nowhere/rig.yaml"),
        ("calibration_file", __file__, "not YAML in line"),
        ("pair_tolerance", -1.0, "pair_tolerance"),
        ("max_curvature", math.nan, "max_curvature"),
        ("hole_clearance", 0.05, "hole_clearance = 0.05 m"),
        ("stage_scale_sigma", 0.5, "stage_scale_sigma"),
    ):
        with pytest.raises(UserError, match=cause) as caught:
            make_tracker(StereoTrackerParameters(**{name: value}))  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)
    monkeypatch.setattr(
        "needle_tracker.filter.needle_tracker.NeedleTracker.warm_up", lambda _: None
    )
    bench = Bench(make_tracker(StereoTrackerParameters(), "left/stereo_tracker"))
    bench.check()
    assert bench.tracker.name == "left/stereo_tracker"
    assert bench.sent["stereo_tracker/calibration"] == [m.Text(calibration_path.read_text())]
