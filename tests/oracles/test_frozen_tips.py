"""Pairs of the frozen run at level camera, rendered again: the tracker finds the frozen tips.

The joints determine the needle; pose, seed and number of an exposure determine its images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from needle_bags.reading.bag_images import TOPICS as IMAGE_TOPICS
from needle_bags.reading.bag_messages import messages_as_sent
from needle_bags.reading.bag_reader import Run, read_run
from needle_bags.ros.rerun import Node
from needle_core.component import Actions, Moment, Publish
from needle_core.convert import from_ros
from needle_core.messages import Image, JointState, Pose
from needle_core.rotations import quaternion_from_rotation
from needle_sim.bench import SimulatedBench
from needle_sim.cameras import CameraSensor
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.optics.calibration import calibration_from
from needle_tracker.stereo_tracker import TIP, StereoTipTracker
from needle_tracker.tracker_parameters import StereoTrackerParameters

ORACLES = Path(__file__).resolve().parent
BAG = ORACLES / "bags" / "camera_best"
TRUTH = "sim/tip_pose"
PAIRS = 6
TOLERANCE = 0.3e-3
"""Largest distance from the frozen tips [m]; both trackers are accurate to a few tenths of a mm."""
BLOCK = 16  # [px]

Floats = npt.NDArray[np.float64]


class FrozenRig:
    """The needle of the frozen run, with today's cameras and tracker.

    Attributes
    ----------
    tips : list of Point
        Tips found by the tracker.
    pose_errors : list of float
        Largest difference of each exposure's pose from the frozen one [m], [-].
    images : dict of str to list of array
        Images of each side.
    """

    def __init__(self, run: Run) -> None:
        settings = parameters(run, "sim_rig", SimRigParameters)
        self._bench = SimulatedBench(settings)
        self._cameras = CameraSensor(self._bench, settings)
        self._tracker = StereoTipTracker(
            parameters(run, "stereo_tracker", StereoTrackerParameters),
            calibration_from(run.calibration, BAG),
        )
        self._rows = {row.topic: row for row in self._tracker.inputs}
        self.topics = {TRUTH, "joint_states", *self._rows}.difference(IMAGE_TOPICS)
        self.tips: list[Any] = []
        self.pose_errors: list[float] = []
        self.images: dict[str, list[Floats]] = {"left": [], "right": []}

    def take(self, topic: str, message: Any, at: Moment) -> None:
        """Handle a frozen message."""
        if topic == TRUTH:
            self._expose(from_ros(Pose, message), at)
            return
        row = self._rows[topic]
        taken = from_ros(row.message, message)
        if isinstance(taken, JointState):
            self._bench.move_to(*taken.positions)
        self._keep(row.handler(taken, at))

    def _expose(self, frozen: Pose, at: Moment) -> None:
        T_rig_tip = self._bench.plant.T_rig_tip
        orientation = quaternion_from_rotation(T_rig_tip[:3, :3].tolist())
        today = np.array([*T_rig_tip[:3, 3], *orientation])
        difference = today - [*frozen.position, *frozen.orientation]
        self.pose_errors.append(float(np.abs(difference).max()))
        for image in self._cameras.expose(len(self.pose_errors) - 1, frozen.stamp_ns):
            assert isinstance(image, Publish)
            if isinstance(image.message, Image):
                self.images[IMAGE_TOPICS[image.topic]].append(block_means(image.message))
            self._keep(self._rows[image.topic].handler(image.message, at))

    def _keep(self, actions: Actions) -> None:
        self.tips += [a.message for a in actions if isinstance(a, Publish) and a.topic == TIP]


def block_means(image: Image) -> Floats:
    pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
    blocks = pixels.reshape(image.height // BLOCK, BLOCK, image.width // BLOCK, BLOCK)
    means: Floats = blocks.mean((1, 3))
    return means


def parameters(run: Run, node: str, kind: type[Any]) -> Any:
    return Node(node, run.parameters[f"/{node}"], frozenset()).parameters(kind)


def messages(topics: set[str]) -> Iterator[tuple[str, Any, Moment]]:
    wanted = {f"/{topic}" for topic in topics}
    for sent, message in messages_as_sent(BAG, wanted.__contains__):
        yield sent.topic.removeprefix("/"), message, Moment(sent.time * 1e-9, sent.time, sent.time)


@pytest.fixture(scope="module")
def run() -> Run:
    return read_run(BAG)


@pytest.fixture(scope="module")
def rig(run: Run) -> FrozenRig:
    rig = FrozenRig(run)
    for topic, message, at in messages(rig.topics):
        if topic != TRUTH or len(rig.pose_errors) < PAIRS:
            rig.take(topic, message, at)
        if len(rig.tips) == PAIRS:
            break
    return rig


def test_joints_lead_the_needle_to_the_frozen_poses(rig: FrozenRig) -> None:
    assert len(rig.pose_errors) == PAIRS
    assert max(rig.pose_errors) < 1e-9


@pytest.mark.parametrize("side", ["left", "right"])
def test_rendered_pairs_look_like_the_frozen_ones(rig: FrozenRig, side: str) -> None:
    with np.load(ORACLES / "pairs.npz") as pairs:
        difference = np.abs(np.array(rig.images[side]) - pairs[side])
    assert difference.shape[0] == PAIRS
    # Grey levels. With other noise of the sensor they differ by 0.2 on average.
    assert difference.mean() < 0.002
    assert difference.max() < 0.05


def test_rendered_pairs_have_the_frozen_tips(run: Run, rig: FrozenRig) -> None:
    assert [tip.stamp_ns for tip in rig.tips] == run.tips.stamps[:PAIRS].tolist()
    for tip, frozen in zip(rig.tips, run.tips.values, strict=False):
        assert math.dist(tip.position, frozen) < TOLERANCE
