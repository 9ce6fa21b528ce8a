"""Cameras and tracker behind a port: passed, returned and lost messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_bringup.simulation.remote_tracker import VISION, RemoteTracker, make_vision
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_core import messages as m
from needle_core.component import Exit, Moment, PortChange, Publish, Send
from needle_sim.bench import SimulatedBench
from needle_sim.cameras import CAMERAS, Exposure
from needle_sim.sim_rig_parameters import SimRigParameters

PARAMETERS = command_line_parameters(parse(["--level", "camera"]), Path())
AT = Moment(3.0, 4_000_000_000)


def exposure(insertion: float, stamp_ns: int = AT.stamp_ns) -> Exposure:
    bench = SimulatedBench(SimRigParameters())
    bench.move_to(insertion, 0.0)
    return Exposure.of(bench, 3, stamp_ns)


def test_an_exposure_becomes_images_and_a_tip_near_the_truth() -> None:
    handle, seen = make_vision(PARAMETERS), exposure(0.05)
    handle((exposure(0.0, 1), Moment(0.0, 1)))
    around = [m.JointState(AT.stamp_ns + n, (m.INSERTION_JOINT,), (0.05,)) for n in (0, 1)]
    # With a known insertion, one pair is enough.
    actions = [action for item in (*around, seen, None) for action in handle((item, AT))]
    sent = {action.topic: action.message for action in actions if isinstance(action, Publish)}
    assert {"stereo/left/image_raw", "stereo/right/camera_info"} <= sent.keys()
    assert sent["needle/tip"].position == pytest.approx(tuple(seen.T_rig_tip[:3, 3]), abs=5e-4)


def test_fast_exposures_are_dropped_and_the_end_of_the_process_ends_the_tracker() -> None:
    tracker, seen = RemoteTracker(), exposure(0.0)
    ports = {port.name: port for port in tracker.ports}
    (row,), (timer,) = tracker.inputs, tracker.timers
    joints = m.JointState(AT.stamp_ns, (m.INSERTION_JOINT,), (0.0,))
    sent = list(ports[CAMERAS].handler((seen, seen, seen), AT))
    assert sent == [Send(VISION, ((seen, AT),))] * 2
    # Joint states and time are never dropped.
    sent = [*row.handler(joints, AT), *timer.handler(AT)]
    assert [action.batch[0][0] for action in sent if isinstance(action, Send)] == [joints, None]
    assert list(ports[CAMERAS].handler((seen,), AT)) == []
    tip = Publish("needle/tip", m.Point(AT.stamp_ns, "rig", (0.0, 0.0, 0.0)))
    assert list(ports[VISION].handler(([tip], []), AT)) == [tip]
    assert len(list(ports[CAMERAS].handler((seen, seen, seen), AT))) == 2
    assert list(ports[VISION].on_change(PortChange("ended"), AT)) == [Exit(1, "ended")]
