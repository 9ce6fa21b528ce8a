"""The node in process: pairs, joints, bad input and what it says about them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ament_index_python.packages import get_package_share_directory
from rclpy.context import Context
from rclpy.parameter import Parameter
from std_msgs.msg import String

from needle_core.errors import UserError
from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import (
    LATCHED,
    to_nanoseconds,
)
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters
from needle_tracker.stereo_tracker import make_tracker

from .node_bench import INSERTION, Bench, Drawer, Images, found


def test_a_pair_gives_tip_and_pose_with_the_exposures_stamp(
    bench: Bench, images: Images, make_arc: Callable[..., np.ndarray]
) -> None:
    pose = bench.pair(1_020_000_000, images)
    bench.until(lambda: len(bench.tips) == 1)
    truth = make_arc(INSERTION, 5.0, 1.0)[-1]
    tip = bench.tips[0]
    assert (tip.header.frame_id, pose.header.frame_id) == ("rig", "rig")
    assert to_nanoseconds(tip.header.stamp) == to_nanoseconds(pose.header.stamp) == 1_020_000_000
    seen = [tip.point.x, tip.point.y, tip.point.z]
    np.testing.assert_allclose(seen, truth, atol=0.3e-3)
    assert seen == [pose.pose.pose.position.x, pose.pose.pose.position.y, pose.pose.pose.position.z]
    assert found(pose)
    covariance = np.reshape(pose.pose.covariance, (6, 6))
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(covariance) > -1e-15)
    assert covariance[:3, :3].trace() < 1e-6
    bench.until(lambda: bench.health["track"][:2] == (0, "TRACKING"))
    bench.until(lambda: bench.health["images"][:2] == (0, "pairs complete"))


def test_late_joiners_are_told_the_calibration_in_use(bench: Bench) -> None:
    told: list[String] = []
    bench.outside.create_subscription(String, "stereo_tracker/calibration", told.append, LATCHED)
    bench.until(lambda: bool(told))
    share = get_package_share_directory("needle_tracker")
    assert told[0].data == Path(share, "config", "calibration.yaml").read_text()


def test_images_wait_for_their_joint_state(bench: Bench, images: Images) -> None:
    assert found(bench.pair(1_000_000_000, images))
    bench.image("left", 1_020_000_000, images[0])
    bench.image("right", 1_020_000_000, images[1])
    # In between only the needle's length says that this is no needle: so it was waited for.
    bench.until(lambda: len(bench.tracker.answers._queue) == 1)
    bench.joints(1_010_000_000)
    bench.joints(1_030_000_000, INSERTION + 0.04)
    assert not found(bench.answer())
    bench.until(lambda: bench.health["track"][1].startswith("TRACKING: no"))


def test_without_joint_states_the_images_alone_count(
    context: Context, images: Images, draw_pair: Drawer, make_arc: Callable[..., np.ndarray]
) -> None:
    bench = Bench(context, joint_timeout=0.05, confirm_pairs=2)
    farther = draw_pair(make_arc(INSERTION + 1e-3, 5.0, 1.0))
    try:
        for number, (pair, wanted) in enumerate(
            ((images, False), (images, False), (farther, True), (farther, True))
        ):
            bench.image("left", number * 1_000_000, pair[0])
            bench.image("right", number * 1_000_000, pair[1])
            assert found(bench.answer()) is wanted
        bench.until(lambda: bench.health["joints"][0] == 1)
    finally:
        bench.close()


def test_in_the_entry_zone_the_insertion_is_the_tip(bench: Bench, images: Images) -> None:
    bench.joints(5, 0.002)
    bench.image("left", 5, images[0])
    bench.image("right", 5, images[1])
    pose = bench.answer()
    assert found(pose)
    assert pose.pose.pose.position.z == 0.002
    bench.until(lambda: bench.health["track"][:2] == (0, "ENTRY"))


def test_left_without_right_is_counted_and_said(bench: Bench, images: Images) -> None:
    for stamp in range(1, 6):
        bench.joints(stamp)
        bench.image("left", stamp, images[0])
    bench.image("right", 99, images[1])
    bench.until(lambda: bench.health["images"][1].startswith("images without"))
    level, _, values = bench.health["images"]
    assert level == 1
    bench.until(lambda: bench.health["images"][2]["left_without_right"] == "2")
    assert values["pairs"] == "0"
    assert not bench.poses
    assert not bench.tips


def test_one_camera_alone_is_said(bench: Bench, images: Images) -> None:
    bench.image("left", 1, images[0])
    bench.until(lambda: bench.health["images"][:2] == (1, "left images without right"))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("calibration_file", "/nowhere/rig.yaml", "/nowhere/rig.yaml"),
        ("calibration_file", __file__, "not YAML in line"),
        ("calibration_file", "/dev/null", "phantom is missing"),
        ("pair_tolerance", -1.0, "pair_tolerance"),
        ("needle_polarity", "grey", "needle_polarity"),
        ("pair_tolerence", 0.0, "did you mean 'pair_tolerance'"),
        ("max_curvature", math.nan, "max_curvature"),
    ],
)
def test_bad_parameters_are_one_line(context: Context, name: str, value: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        ComponentNode(
            "stereo_tracker",
            StereoTrackerParameters,
            make_tracker,
            context=context,
            parameter_overrides=[Parameter(name, value=value)],
        )
