"""The node in process: pairs, joints, bad input and what it says about them."""

from __future__ import annotations

import array
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String

from needle_common.errors import UserError
from needle_common.ros.conversions import (
    IMAGES,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
)
from needle_tracker.ros.stereo_tracker import StereoTrackerNode
from own_context import own_context

LIMIT = 20.0
INSERTION = 0.05

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]
Images = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def images(draw_pair: Drawer, make_arc: Callable[..., np.ndarray]) -> Images:
    return draw_pair(make_arc(INSERTION, 5.0, 1.0))


@pytest.fixture
def context() -> Iterator[Context]:
    with own_context() as context:
        yield context


class Bench:
    """The node under test and everything around it, on one executor."""

    def __init__(self, context: Context, **parameters: Any) -> None:
        self.node = StereoTrackerNode(
            context=context,
            parameter_overrides=[Parameter(name, value=v) for name, v in parameters.items()],
        )
        self.outside = Node("outside", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        for node in (self.node, self.outside):
            self._executor.add_node(node)
        self.tips: list[PointStamped] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.health: defaultdict[str, tuple[int, str, dict[str, str]]] = defaultdict(
            lambda: (-1, "", {})
        )
        outside = self.outside
        outside.create_subscription(PointStamped, "needle/tip", self.tips.append, RELIABLE)
        outside.create_subscription(
            PoseWithCovarianceStamped, "needle/tip_pose", self.poses.append, RELIABLE
        )
        outside.create_subscription(DiagnosticArray, "/diagnostics", self._on_health, RELIABLE)
        self._joints = outside.create_publisher(JointState, "joint_states", JOINT_STATES)
        self._images = {
            side: outside.create_publisher(Image, f"stereo/{side}/image_raw", IMAGES)
            for side in ("left", "right")
        }
        self._infos = outside.create_publisher(CameraInfo, "stereo/left/camera_info", IMAGES)
        publishers = [self._joints, self._infos, *self._images.values()]
        self.until(lambda: all(p.get_subscription_count() for p in publishers))
        answers = self.node._outputs.values()
        self.until(lambda: all(p.get_subscription_count() for p in answers))

    def close(self) -> None:
        for node in (self.node, self.outside):
            self._executor.remove_node(node)
            node.destroy_node()
        self._executor.shutdown()

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            part = status.name.split(": ")[1]
            self.health[part] = (status.level[0], status.message, values)

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            self._executor.spin_once(timeout_sec=0.05)

    def joints(self, stamp: int, insertion: float = INSERTION) -> None:
        message = JointState(name=["rotation_joint", "insertion_joint"], position=[0.0, insertion])
        message.header.stamp = to_stamp(stamp)
        self._joints.publish(message)

    def image(
        self,
        side: str,
        stamp: int,
        pixels: np.ndarray,
        encoding: str = "mono8",
        cut_off: int = 0,
    ) -> None:
        height, width = pixels.shape
        message = Image(height=height, width=width, step=width, encoding=encoding)
        message.header.stamp = to_stamp(stamp)
        data = array.array("B")
        data.frombytes(pixels.tobytes()[: pixels.size - cut_off])
        message.data = data
        self._images[side].publish(message)

    def camera_info(self, width: int, height: int) -> None:
        self._infos.publish(CameraInfo(width=width, height=height))

    def pair(self, stamp: int, images: Images) -> PoseWithCovarianceStamped:
        """Publish a pair with its joint state, and return the answer."""
        self.joints(stamp)
        self.image("left", stamp, images[0])
        self.image("right", stamp, images[1])
        return self.answer()

    def answer(self) -> PoseWithCovarianceStamped:
        wanted = len(self.poses) + 1
        self.until(lambda: len(self.poses) >= wanted)
        return self.poses[-1]


@pytest.fixture
def bench(context: Context) -> Iterator[Bench]:
    bench = Bench(context)
    yield bench
    bench.close()


def found(pose: PoseWithCovarianceStamped) -> bool:
    diagonal = np.reshape(pose.pose.covariance, (6, 6)).diagonal()
    assert np.all(np.isfinite(diagonal)) or np.all(np.isinf(diagonal))
    return bool(np.all(np.isfinite(diagonal)))


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


def test_no_image_is_taken_before_the_recorder_listens(context: Context) -> None:
    node = StereoTrackerNode(
        context=context, parameter_overrides=[Parameter("wait_for_recorder", value=True)]
    )
    recorder = Node("recorder", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    executor.add_node(recorder)

    def spin_until(condition: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            executor.spin_once(timeout_sec=0.05)

    try:
        recorder.create_subscription(PointStamped, "needle/tip", lambda _: None, RELIABLE)
        spin_until(lambda: node._outputs["needle/tip"].get_subscription_count() == 1)
        node._check()
        assert node.count_subscribers("stereo/left/image_raw") == 0
        recorder.create_subscription(
            PoseWithCovarianceStamped, "needle/tip_pose", lambda _: None, RELIABLE
        )
        spin_until(lambda: node._outputs["needle/tip_pose"].get_subscription_count() == 1)
        node._check()
        # Nor before those who publish joints and estimates know this node.
        assert node.count_subscribers("stereo/left/image_raw") == 0
        recorder.create_publisher(JointState, "joint_states", JOINT_STATES)
        recorder.create_publisher(PoseWithCovarianceStamped, "needle/estimate", RELIABLE)
        spin_until(
            lambda: all(
                node.count_subscribers(f"stereo/{side}/image_raw") for side in ("left", "right")
            )
        )
    finally:
        for each in (node, recorder):
            executor.remove_node(each)
            each.destroy_node()
        executor.shutdown()


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
    bench.until(lambda: len(bench.node._answers._queue) == 1)
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
    ("spoil", "encoding", "reason"),
    [
        (lambda image: image, "rgb8", "right image has 786432 bytes in rows of 1024"),
        (lambda image: image, "mono16", "right image is 'mono16', wants 8 bits, such as mono8"),
        (lambda image: image[:480, :640], "mono8", "right image is 640x480, the calibration is"),
    ],
)
def test_bad_images_are_answered_without_a_tip_and_named(
    bench: Bench,
    images: Images,
    spoil: Callable[[np.ndarray], np.ndarray],
    encoding: str,
    reason: str,
) -> None:
    bench.joints(10)
    bench.image("left", 10, images[0])
    bench.image("right", 10, spoil(images[1]), encoding)
    pose = bench.answer()
    assert not found(pose)
    assert pose.pose.pose.orientation.w == 1.0
    bench.until(lambda: bench.health["images"][0] == 2 and reason in bench.health["images"][1])
    bench.until(lambda: bench.health["images"][2]["pairs_refused"] == "1")
    assert not bench.tips
    assert found(bench.pair(20, images))


def test_reasons_without_end_are_told_in_a_report_of_bounded_length(bench: Bench) -> None:
    pixels = np.zeros((2, 2), np.uint8)
    count = 50
    for number in range(count):
        bench.joints(10 + number)
        bench.image("left", 10 + number, pixels, f"{number} " + "x" * 3000)
        bench.image("right", 10 + number, pixels)
        assert not found(bench.answer())
    bench.until(lambda: bench.health["images"][2].get("pairs_refused") == str(count))
    last = f"'{count - 1} x"
    bench.until(lambda: all(last in bench.health[part][1] for part in ("images", "track")))
    for part, kind in (("images", "refused: "), ("track", "no tip: ")):
        told = {k: int(v) for k, v in bench.health[part][2].items() if k.startswith(kind)}
        assert sum(told.values()) == count
        assert told[f"{kind}other reasons"] == count - 20
        assert list(told)[-2].startswith(f"{kind}left image is '{count - 1} x")
        assert max(map(len, [*told, bench.health[part][1]])) < 120


def test_an_image_without_all_its_bytes_is_no_tip(bench: Bench, images: Images) -> None:
    bench.joints(10)
    bench.image("left", 10, images[0], cut_off=1)
    bench.image("right", 10, images[1])
    assert not found(bench.answer())
    wanted = "pair refused: left image has 786431 bytes in rows of 1024"
    bench.until(lambda: bench.health["images"][1].startswith(wanted))
    assert not bench.tips


def test_a_black_frame_is_no_tip(bench: Bench, images: Images) -> None:
    assert not found(bench.pair(10, (images[0], np.zeros_like(images[1]))))
    bench.until(lambda: "right image is black" in bench.health["track"][1])
    assert bench.health["track"][0] == 1


def test_time_running_backwards_is_no_tip(bench: Bench, images: Images) -> None:
    assert found(bench.pair(5_000_000_000, images))
    assert not found(bench.pair(4_990_000_000, images))
    bench.until(lambda: "ran backwards" in bench.health["images"][1])
    assert not found(bench.pair(5_000_000_000, images))
    bench.until(lambda: "repeated" in bench.health["images"][1])
    assert found(bench.pair(5_010_000_000, images))
    # Far back a new recording has begun: its first pair is refused, the next is looked at.
    assert not found(bench.pair(1_000_000_000, images))
    assert found(bench.pair(1_010_000_000, images))
    assert len(bench.tips) <= 3


def test_a_camera_that_runs_at_another_resolution_gives_no_tip(
    bench: Bench, images: Images
) -> None:
    bench.camera_info(640, 480)
    bench.until(lambda: bench.health["images"][0] == 2)
    reason = "left camera_info is for 640x480, the calibration for 1024x768"
    assert bench.health["images"][1] == reason
    assert not found(bench.pair(10, images))
    bench.until(lambda: bench.health["images"][1] == f"pair refused: {reason}")
    assert bench.health["images"][2][f"refused: {reason}"] == "1"
    assert not bench.tips
    # A driver that knows nothing contradicts nothing.
    bench.camera_info(0, 0)
    bench.until(lambda: not bench.node._health.camera_info["left"])
    assert found(bench.pair(20, images))


def test_a_calibration_for_another_resolution_gives_no_tip(
    context: Context, images: Images, calibration_path: Path, tmp_path: Path
) -> None:
    text = calibration_path.read_text()
    other = tmp_path / "other.yaml"
    other.write_text(text.replace("image_width: 1024", "image_width: 1280"))
    bench = Bench(context, calibration_file=str(other))
    try:
        assert not found(bench.pair(10, images))
        wanted = "left image is 1024x768, the calibration is for 1280x768"
        bench.until(lambda: bench.health["images"][2].get(f"refused: {wanted}") == "1")
        assert bench.health["images"][:2] == (2, f"pair refused: {wanted}")
        assert not bench.tips
    finally:
        bench.close()


def test_the_same_images_from_both_cameras_are_no_tip(bench: Bench, images: Images) -> None:
    """One camera wired to both topics: its two rays never meet in the phantom."""
    assert not found(bench.pair(10, (images[0], images[0])))
    assert not found(bench.pair(20, (images[1], images[0])))
    bench.until(lambda: bench.health["track"][0] == 1)
    assert not bench.tips


def test_swapped_images_are_suspected_aloud(bench: Bench, images: Images) -> None:
    left, right = images
    for k in range(1, 13):
        assert not found(bench.pair(10 * k, (right, left)))
    bench.until(lambda: "seem to be swapped" in bench.health["images"][1])
    assert bench.health["images"][0] == 1
    assert "parameters left and right" in bench.health["images"][1]
    assert found(bench.pair(1000, images))
    bench.until(lambda: bench.health["images"][0] == 0)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("calibration_file", "/nowhere/rig.yaml", "/nowhere/rig.yaml"),
        ("calibration_file", __file__, "is not YAML"),
        ("calibration_file", "/dev/null", "phantom is missing"),
        ("pair_tolerance", -1.0, "pair_tolerance"),
        ("needle_polarity", "grey", "needle_polarity"),
        ("pair_tolerence", 0.0, "did you mean 'pair_tolerance'"),
        ("max_curvature", math.nan, "max_curvature"),
    ],
)
def test_bad_parameters_are_one_line(context: Context, name: str, value: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        StereoTrackerNode(context=context, parameter_overrides=[Parameter(name, value=value)])
