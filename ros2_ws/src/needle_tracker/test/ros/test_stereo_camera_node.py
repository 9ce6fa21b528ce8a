"""Image sources, the node that publishes them, and the live check that takes them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image

from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain
from needle_core.ros.conversions import IMAGES, RELIABLE, to_nanoseconds
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.ros.stereo_camera import StereoCameraNode
from needle_tracker.sources.stereo_source import (
    LOST_AFTER,
    CameraPair,
    EndOfRecordingError,
    RateMeter,
    SourceSettings,
    StereoSource,
    open_source,
)
from own_context import own_context

LIMIT = 20.0
SIZES = {"left": (64, 48), "right": (64, 48)}


class Clock:
    """Every look at it is 1 ms later."""

    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        self.now += 1_000_000
        return self.now


class FakeCapture:
    """A camera of which each grab and retrieve is noted."""

    def __init__(self, name: str, log: list[str], good: bool = True, width: int = 64) -> None:
        self.name, self.log, self.good, self.width = name, log, good, width
        self.opened = True

    def isOpened(self) -> bool:
        return self.opened

    def set(self, key: int, value: float) -> bool:
        return True

    def grab(self) -> bool:
        self.log.append(f"grab {self.name}")
        return self.good

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        self.log.append(f"retrieve {self.name}")
        return True, np.full((48, self.width, 3), 7, np.uint8)

    def release(self) -> None:
        self.opened = False


def settings(left: object, right: object, **others: Any) -> SourceSettings:
    values: dict[str, Any] = {"sizes": SIZES, "rate": 100.0, "loop": False} | others
    return SourceSettings(str(left), str(right), **values)


def cameras(log: list[str], **of_right: Any) -> tuple[CameraPair, dict[str, FakeCapture]]:
    captures = {"0": FakeCapture("0", log), "2": FakeCapture("2", log, **of_right)}
    opened: Callable[[str], Any] = captures.__getitem__
    return CameraPair(settings(0, 2), Clock(), opened), captures


def write_pairs(folder: Path, count: int, size: tuple[int, int] = (64, 48)) -> tuple[Path, Path]:
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for i in range(count):
            level = 10 * i + (5 if side == "right" else 0)
            image = np.full(size[::-1], level, np.uint8)
            cv2.imwrite(str(folder / side / f"{i:03d}.png"), image)
    return folder / "left", folder / "right"


def test_both_cameras_are_grabbed_before_either_is_decoded() -> None:
    log: list[str] = []
    source, captures = cameras(log)
    pair = source.next()
    assert pair is not None
    assert log == ["grab 0", "grab 2", "retrieve 0", "retrieve 2"]
    assert (pair.left_stamp, pair.right_stamp) == (1_000_000, 2_000_000)
    assert pair.left.shape == (48, 64)
    assert pair.left.dtype == np.uint8
    source.close()
    assert not any(capture.opened for capture in captures.values())


def test_a_camera_that_gives_nothing_is_counted_and_then_gone() -> None:
    source, captures = cameras([])
    captures["2"].good = False
    for dropped in range(1, LOST_AFTER):
        assert source.next() is None
        assert source.dropped == dropped
    captures["2"].good = True
    assert source.next() is not None
    captures["2"].good = False
    with pytest.raises(UserError, match="20 times in a row"):
        for _ in range(LOST_AFTER):
            source.next()


def test_a_camera_of_another_size_is_refused() -> None:
    source, _ = cameras([], width=80)
    with pytest.raises(UserError, match="right image is 80x48, the calibration is for 64x48"):
        source.next()


def test_folders_come_in_order_and_end(tmp_path: Path) -> None:
    source = open_source(settings(*write_pairs(tmp_path, 3)), Clock())
    for i in range(3):
        pair = source.next()
        assert pair is not None
        assert (pair.left[0, 0], pair.right[0, 0]) == (10 * i, 10 * i + 5)
        assert pair.left_stamp == pair.right_stamp
    with pytest.raises(EndOfRecordingError):
        source.next()


def test_a_recording_in_a_loop_begins_again(tmp_path: Path) -> None:
    source = open_source(settings(*write_pairs(tmp_path, 2), loop=True), Clock())
    pairs = [source.next() for _ in range(5)]
    assert [pair.left[0, 0] for pair in pairs if pair] == [0, 10, 0, 10, 0]
    assert len({pair.left_stamp for pair in pairs if pair}) == 5


def test_an_unreadable_image_is_dropped_with_its_partner(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path, 3)
    (right / "001.png").write_bytes(b"no image")
    source = open_source(settings(left, right), Clock())
    assert [source.next() is None for _ in range(3)] == [False, True, False]
    assert source.dropped == 1


def test_an_image_of_16_bit_is_none_of_the_camera(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path, 2)
    cv2.imwrite(str(left / "001.png"), np.full((48, 64), 3000, np.uint16))
    source = open_source(settings(left, right), Clock())
    assert [source.next() is None for _ in range(2)] == [False, True]


def write_video(path: Path, count: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()
    return path


def levels_of(source: StereoSource) -> list[int]:
    levels = []
    with pytest.raises(EndOfRecordingError):
        while True:
            pair = source.next()
            assert pair is not None
            levels.append(int(pair.left[24, 32]))
    return levels


def test_videos_serve_as_folders_do(tmp_path: Path) -> None:
    left, right = (write_video(tmp_path / f"{side}.avi", 4) for side in ("left", "right"))
    source = open_source(settings(left, right), Clock())
    np.testing.assert_allclose(levels_of(source), [0, 40, 80, 120], atol=3)
    assert not source.missing


def test_a_video_that_is_longer_or_cut_off_is_said(tmp_path: Path) -> None:
    left, right = write_video(tmp_path / "left.avi", 6), write_video(tmp_path / "right.avi", 4)
    source = open_source(settings(left, right), Clock())
    assert len(levels_of(source)) == 4
    assert source.missing == "2 frames without a partner"
    whole = left.read_bytes()
    for path in (left, right):
        path.write_bytes(whole[: whole.index(b"movi") + (len(whole) - whole.index(b"movi")) // 2])
    source = open_source(settings(left, right), Clock())
    seen = len(levels_of(source))
    assert seen < 6
    assert f"{6 - seen} of 6 pairs cannot be read" in source.missing


def test_sources_that_are_wrong(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path / "good", 2)
    other = write_pairs(tmp_path / "large", 2, (80, 60))[0]
    (tmp_path / "empty").mkdir()
    for pair, says in (
        (("", right), "left is empty"),
        ((left, tmp_path / "none"), "does not exist"),
        ((left, tmp_path / "empty"), "no images"),
        ((left, 0), "one is a camera"),
        ((3, 3), "same camera"),
        (("/dev/no_camera", "/dev/no_other"), "/dev/no_camera does not exist"),
        ((left, other), "80x60"),
        ((62, 63), "left camera 62 cannot be opened"),
        (("/dev/null", "/dev/zero"), "left camera /dev/null cannot be opened"),
    ):
        with pytest.raises(UserError, match=says):
            open_source(settings(*pair), Clock())
    (left / "000.png").unlink()
    with pytest.raises(UserError, match=r"right 000\.png"):
        open_source(settings(left, right), Clock())


def test_the_rate_is_that_of_the_last_seconds() -> None:
    meter = RateMeter(window=5.0)
    assert meter.rate(0.0) == 0.0
    for i in range(21):
        meter.tick(0.1 * i)
    assert meter.rate(2.0) == pytest.approx(10.0)
    assert meter.rate(20.0) == 0.0


@pytest.fixture
def context() -> Iterator[Context]:
    with own_context() as context:
        yield context


def test_the_node_publishes_pairs_with_their_calibration(
    tmp_path: Path, context: Context, calibration: StereoCalibration
) -> None:
    left, right = write_pairs(tmp_path, 5, (1024, 768))
    given = {"left": str(left), "right": str(right), "rate": 50.0, "wait_for_subscribers": True}
    node = StereoCameraNode(
        context=context,
        parameter_overrides=[Parameter(name, value=value) for name, value in given.items()],
    )
    outside = Node("outside", context=context)
    got: dict[str, list[Any]] = {key: [] for key in ("left", "right", "info", "health")}
    for side in ("left", "right"):
        outside.create_subscription(Image, f"stereo/{side}/image_raw", got[side].append, IMAGES)
    outside.create_subscription(CameraInfo, "stereo/right/camera_info", got["info"].append, IMAGES)
    outside.create_subscription(DiagnosticArray, "/diagnostics", got["health"].append, RELIABLE)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    executor.add_node(outside)
    end = time.monotonic() + LIMIT
    while not (node.finished and len(got["right"]) == len(got["left"]) == 5):
        assert time.monotonic() < end, "waited in vain"
        executor.spin_once(timeout_sec=0.1)
    node._report()
    node.close()
    executor.shutdown()
    for node_ in (node, outside):
        node_.destroy_node()
    stamps = [to_nanoseconds(message.header.stamp) for message in got["left"]]
    assert stamps == [to_nanoseconds(message.header.stamp) for message in got["right"]]
    assert stamps == sorted(set(stamps))
    first = got["right"][1]
    assert (first.encoding, first.width, first.height, first.step) == ("mono8", 1024, 768, 1024)
    assert first.header.frame_id == "right_camera_optical"
    assert set(first.data) == {15}
    info = got["info"][0]
    np.testing.assert_allclose(np.reshape(info.k, (3, 3)), calibration.right.camera_matrix)
    np.testing.assert_allclose(info.d, calibration.right.distortion)


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    with own_domain() as domain:
        yield os.environ | {"ROS_DOMAIN_ID": str(domain)}


def run(environment: dict[str, str], module: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", f"needle_tracker.ros.{module}", *words],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_the_end_of_a_recording_is_a_clean_end(tmp_path: Path, environment: dict[str, str]) -> None:
    left, right = write_pairs(tmp_path, 2, (1024, 768))
    given = ["-p", f"left:={left}", "-p", f"right:={right}", "-p", "rate:=100.0"]
    ended = run(environment, "stereo_camera", "--ros-args", *given)
    assert (ended.returncode, "2 pairs" in ended.stdout + ended.stderr) == (0, True)


def test_a_missing_camera_is_one_line_and_exit_2(environment: dict[str, str]) -> None:
    given = ["-p", "left:=/dev/no_camera", "-p", "right:=/dev/no_other"]
    ended = run(environment, "stereo_camera", "--ros-args", *given)
    assert ended.returncode == 2
    assert ended.stderr.splitlines() == ["error: left camera /dev/no_camera does not exist"]


def test_a_live_check_takes_its_images_from_the_topics(
    tmp_path: Path, calibration_path: Path, environment: dict[str, str]
) -> None:
    """Images without a board come through, and are refused for that."""
    left, right = write_pairs(tmp_path, 2, (1024, 768))
    session = tmp_path / "session.yaml"
    session.write_text(
        "board: {columns: 12, rows: 9, square: 0.01, marker: 0.0075, dictionary: DICT_5X5_100}\n"
        "phantom: {surface_height: 0.0175, refractive_index: 1.3}\n"
        "places: {top: {origin: [0.018, -0.045, 0.0]}}\n"
    )
    words = ["--calibration", str(calibration_path), "--session", str(session), "--live", "top"]
    silent = run(environment, "check_calibration", *words, "--timeout", "0.5")
    assert silent.returncode == 2
    assert silent.stderr.startswith("error: 0 image pairs of 10 in 0.5 s")

    camera = subprocess.Popen(
        [sys.executable, "-m", "needle_tracker.ros.stereo_camera", "--ros-args", "-p",
         f"left:={left}", "-p", f"right:={right}", "-p", "loop:=true", "-p", "rate:=10.0"],
        env=environment,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        seen = run(environment, "check_calibration", *words, "--timeout", "40", "--count", "3")
    finally:
        camera.terminate()
        assert camera.wait(timeout=LIMIT) == 0
    assert seen.returncode == 2
    assert seen.stderr == (
        "error: no image shows the session's board (12 x 9 squares of 10 mm, markers 7.5 mm, "
        "DICT_5X5_100): its markers identify no other board either\n"
    )
