"""The node that publishes image pairs, and the live check that takes them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from needle_core.process.ros_domain import own_domain
from needle_core.ros.component_node import ComponentNode
from needle_tracker.sources.pair_port import PairPort
from needle_tracker.stereo_camera import PAIRS, StereoCameraParameters, make_camera
from own_context import own_context

LIMIT = 20.0


@pytest.fixture
def context() -> Iterator[Context]:
    with own_context() as context:
        yield context


def test_a_mistake_of_the_source_ends_the_node(context: Context) -> None:
    """An error of a thread that nobody hears would leave a node that gives no images."""
    node = ComponentNode(
        "stereo_camera",
        StereoCameraParameters,
        make_camera,
        lambda _: {PAIRS: PairPort(mock.Mock(**{"next.side_effect": ZeroDivisionError}))},
        context=context,
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        with pytest.raises(ZeroDivisionError):
            for _ in range(100):
                executor.spin_once(timeout_sec=0.1)
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    with own_domain() as domain:
        yield os.environ | {"ROS_DOMAIN_ID": str(domain)}


def write_pairs(folder: Path) -> tuple[Path, Path]:
    for side in ("left", "right"):
        (folder / side).mkdir()
        for name in ("0.png", "1.png"):
            cv2.imwrite(str(folder / side / name), np.zeros((768, 1024), np.uint8))
    return folder / "left", folder / "right"


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
    left, right = write_pairs(tmp_path)
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
    left, right = write_pairs(tmp_path)
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
