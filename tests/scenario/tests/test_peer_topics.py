"""A peer reads the needle from peer_topics, and proposes the target that the needle reaches."""

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

FILE = Path(needle_bags.__file__).parents[1] / "config" / "peers.yaml"
SHAPE, BASE = "/needle/state/current_shape", "/stage/state/needle_pose"
TARGET = (0.001, -0.0005, 0.038)


class Peer(Component):
    """Reads shape and base as trajcontrol does, proposes a target, and accepts it.

    trajcontrol takes the last pose of the shape as the tip, pairs it with a base within 0.1 s, and
    divides by the differences of their stamps.
    """

    name = "peer"
    outputs = (Output("/subject/state/target", m.Point),)

    def __init__(self) -> None:
        self.latest: dict[str, Any] = {}
        self.pairs: list[tuple[int, int]] = []
        self.answers: list[bool] = []
        kinds = {SHAPE: m.Poses, BASE: m.Pose, "sim/tip_pose": m.Pose}
        self.inputs = tuple(
            Input(topic, kind, partial(self._receive, topic)) for topic, kind in kinds.items()
        )
        self.timers = (Timer(1.0, self._propose), Timer(4.5, self._accept))

    def _receive(self, topic: str, message: Any, at: Moment) -> Actions:
        self.latest[topic] = message
        if topic == SHAPE and BASE in self.latest:
            self.pairs.append((message.stamp_ns, self.latest[BASE].stamp_ns))
        return ()

    def _propose(self, at: Moment) -> Actions:
        x, y, z = (1e3 * part for part in TARGET)
        yield Publish("/subject/state/target", m.Point(at.stamp_ns, "stage", (y, z, x)))

    def _accept(self, at: Moment) -> Actions:
        # Before the first proposal there is nothing to accept.
        if not any(self.answers):
            yield Call("plane_controller/accept_target")

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer.success)
        return ()


def test_a_peer_follows_the_needle_to_the_target_that_it_proposed() -> None:
    options = parse(["--level", "tip", "--noise-mm", "1.0", "--depth-mm", "40"])
    rig = make_components(command_line_parameters(options, Path("unused")))
    peer, topics = Peer(), PeerTopics(PeerTopicsParameters(), read_peer_topics(FILE))
    VirtualRunner([*rig, topics, peer], seed=1).run(60.0)
    assert peer.answers == [False, True]
    tip = np.array(peer.latest["sim/tip_pose"].position)
    assert np.linalg.norm(tip - TARGET) < 1e-3
    # In mm; the needle ends at the target, before the depth of the run.
    np.testing.assert_allclose(peer.latest[SHAPE].poses[-1][0], 1e3 * tip, atol=1.2)
    assert peer.latest[BASE].position[2] == pytest.approx(38.0, abs=0.6)
    stamps = np.array(peer.pairs)
    assert np.all(np.diff(stamps, axis=0) > 0)
    assert np.max(np.abs(stamps[:, 0] - stamps[:, 1])) < 100_000_000
