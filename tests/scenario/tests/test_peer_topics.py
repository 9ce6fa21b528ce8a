"""peer_topics of a steered rig, read as other packages read these topics."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import needle_bags
from needle_bags.live.peer_topics import PeerTopics, PeerTopicsParameters, read_peer_topics
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_components
from needle_core import messages as m
from needle_core.component import (
    Actions,
    Answer,
    Call,
    Component,
    Input,
    Moment,
    Output,
    Publish,
    Timer,
)
from needle_core.runners.virtual import VirtualRunner
from needle_core.status_messages import ControllerStatus
from needle_sim.sim_rig import SimRig

FILE = Path(needle_bags.__file__).parents[1] / "config" / "peers.yaml"
SHAPE, ENTRY, BASE = (
    "/needle/state/current_shape",
    "/needle/state/skin_entry",
    "/stage/state/needle_pose",
)
TARGET = (0.001, -0.0005, 0.038)
DEPTH_MM = 40.0


class Peer(Component):
    """Reads shape, entry and base as SmartNeedle and trajcontrol do, and publishes a target.

    SmartNeedle's insertion depth is z of the base minus z of the entry; trajcontrol takes the last
    pose of the shape as the tip, pairs it with a base within 0.1 s, and divides by the differences
    of their stamps.
    """

    name = "peer"
    outputs = (Output("/subject/state/target", m.Point),)

    def __init__(self) -> None:
        self.latest: dict[str, Any] = {}
        self.depths: list[float] = []
        self.pairs: list[tuple[int, int]] = []
        self.tips: list[tuple[float, float, float]] = []
        self.answers: list[Answer] = []
        kinds = {SHAPE: m.Poses, ENTRY: m.BarePoint, BASE: m.Pose}
        self.inputs = (
            *(Input(topic, kind, partial(self._receive, topic)) for topic, kind in kinds.items()),
            Input("needle/controller_status", ControllerStatus, partial(self._receive, "status")),
        )
        self.timers = (Timer(1.0, self._propose), Timer(4.5, self._accept))

    def _receive(self, topic: str, message: Any, at: Moment) -> Actions:
        self.latest[topic] = message
        if topic == BASE and ENTRY in self.latest:
            self.depths.append(message.position[2] - self.latest[ENTRY].position[2])
        if topic == SHAPE and BASE in self.latest:
            self.pairs.append((message.stamp_ns, self.latest[BASE].stamp_ns))
            self.tips.append(message.poses[-1][0])
        return ()

    def _propose(self, at: Moment) -> Actions:
        x, y, z = (1e3 * part for part in TARGET)
        yield Publish("/subject/state/target", m.Point(at.stamp_ns, "stage", (y, z, x)))

    def _accept(self, at: Moment) -> Actions:
        # Before the first proposal there is nothing to accept.
        if not any(answer.success for answer in self.answers):
            yield Call("plane_controller/accept_target")

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer)
        return ()


@pytest.fixture(scope="module")
def steered() -> tuple[Peer, PeerTopics, SimRig]:
    options = parse(["--level", "tip", "--noise-mm", "1.0", "--depth-mm", str(DEPTH_MM)])
    rig, *others = make_components(command_line_parameters(options, Path("unused")))
    assert isinstance(rig, SimRig)
    peer, topics = Peer(), PeerTopics(PeerTopicsParameters(), read_peer_topics(FILE))
    runner = VirtualRunner([rig, *others, topics, peer], seed=1)
    runner.run(60.0)
    return peer, topics, rig


def test_a_peer_reads_depth_and_tip_in_mm(steered: tuple[Peer, PeerTopics, SimRig]) -> None:
    peer, _, rig = steered
    # The needle ends at the target, before the depth of the run.
    assert peer.depths[-1] == pytest.approx(1e3 * bench(rig).insertion, abs=0.05)
    assert peer.depths[-1] < DEPTH_MM - 1.0
    assert np.all(np.diff(peer.depths) >= -1e-9)
    # Each pair has newer stamps than the one before: a peer divides by their difference.
    stamps = np.array(peer.pairs)
    assert np.all(np.diff(stamps, axis=0) > 0)
    assert np.max(np.abs(stamps[:, 0] - stamps[:, 1])) < 100_000_000
    path = rig_path(rig) * 1e3
    assert len(peer.tips) > 30
    assert distances(np.array(peer.tips), path).max() < 1.2


def test_the_shape_is_nearer_to_the_needle_than_the_measured_tips(
    steered: tuple[Peer, PeerTopics, SimRig],
) -> None:
    _, topics, rig = steered
    shape, measured = topics._needle.shape, topics._needle.shaft
    assert shape is not None
    assert measured is not None
    path = rig_path(rig)
    of_shape, of_tips = (rms(distances(p, path)) for p in (shape[1][:, :3, 3], measured))
    assert of_shape < 0.5e-3 < of_tips


def test_an_accepted_proposal_becomes_the_target(steered: tuple[Peer, PeerTopics, SimRig]) -> None:
    peer, _, rig = steered
    assert [answer.success for answer in peer.answers] == [False, True]
    assert peer.latest["status"].target_point_m == pytest.approx(TARGET)
    assert np.linalg.norm(rig_path(rig)[-1] - TARGET) < 1e-3


def bench(rig: SimRig) -> Any:
    sensor: Any = rig._sensor
    return sensor._bench


def rig_path(rig: SimRig) -> Any:
    return bench(rig).plant.centreline(1e-4)


def distances(points: Any, path: Any) -> Any:
    """Return the distance of each point from a path."""
    return np.min(np.linalg.norm(points[:, None] - path[None], axis=2), axis=1)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(values**2)))
