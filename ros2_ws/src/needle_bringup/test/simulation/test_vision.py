"""Cameras and tracker behind a port: what is handed on, what comes back, what is lost."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

import pytest

from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import settings_of
from needle_bringup.simulation.vision import EYES, DistantTracker, Done, Eyes
from needle_core import messages as m
from needle_core.component import (
    Action,
    Actions,
    Component,
    Exit,
    Input,
    Moment,
    Output,
    Port,
    PortChange,
    Publish,
    Send,
    Timer,
)
from needle_core.runners.virtual import DIAGNOSTICS, VirtualRunner
from needle_sim.camera_sensor import CAMERAS, Exposure
from needle_sim.rig.bench import SimulatedBench
from needle_sim.sim_rig_parameters import SimRigParameters

PARAMETERS = command_line_parameters(parse(["--level", "camera"]), Path())
EXPOSURE_PERIOD = 0.1


def exposure(number: int, insertion: float) -> Exposure:
    settings = settings_of(SimRigParameters, PARAMETERS, "sim_rig")
    bench = SimulatedBench(
        curvature=settings.curvature,
        pitch=settings.initial_pitch,
        roll=settings.initial_roll,
        torsion_play=0.0,
        torsion_lag=0.0,
        tip_noise=0.0,
        seed=1,
    )
    bench.move_to(insertion, 0.0)
    return Exposure.of(bench, number, 1_000_000_000 * (1 + number))


def test_an_exposure_becomes_images_and_a_tip_near_the_truth() -> None:
    eyes, seen = Eyes(PARAMETERS), exposure(3, 0.05)
    actions = list(eyes.handle(seen, Moment(3.0, seen.stamp_ns)))
    for late in (0, 1):
        joints = m.JointState(seen.stamp_ns + late, (m.INSERTION_JOINT,), (0.05,))
        actions += eyes.handle(joints, Moment(3.0, seen.stamp_ns))
    sent = {action.topic: action.message for action in actions if isinstance(action, Publish)}
    assert {"stereo/left/image_raw", "stereo/right/camera_info"} <= sent.keys()
    assert sent["needle/tip"].position == pytest.approx(tuple(seen.T_rig_tip[:3, 3]), abs=5e-4)


class Rig(Component):
    """Exposes all the time, and notes the tips and troubles that it hears."""

    name = "rig"

    def __init__(self) -> None:
        self.exposed = 0
        self.tips: list[m.Point] = []
        self.troubles: list[str] = []
        self.inputs = (
            Input("needle/tip", m.Point, self._on_tip),
            Input(DIAGNOSTICS.topic, m.Diagnostics, self._on_health),
        )
        self.outputs = (Output("joint_states", m.JointState),)
        self.timers = (Timer(EXPOSURE_PERIOD, self._expose),)

    def _expose(self, at: Moment) -> Actions:
        yield Publish("joint_states", m.JointState(at.stamp_ns, (m.INSERTION_JOINT,), (0.0,)))
        yield Send(CAMERAS, (exposure(self.exposed, 0.0),))
        self.exposed += 1

    def _on_tip(self, message: m.Point, at: Moment) -> Actions:
        self.tips.append(message)
        return ()

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        self.troubles += [status.text for status in message.statuses]
        return ()


class SlowEyes(Component):
    """The process that works, as a component: an exposure takes it five exposures' time."""

    name = "slow_eyes"

    def __init__(self) -> None:
        self.worked = 0
        self.fails = False
        self._waiting: list[tuple[object, Moment]] = []
        self.ports = (Port(EYES, self._take),)
        self.timers = (Timer(5.0 * EXPOSURE_PERIOD, self._work),)

    def _take(self, batch: Sequence[tuple[object, Moment]], at: Moment) -> Actions:
        self._waiting += batch
        return ()

    def _work(self, at: Moment) -> Actions:
        for item, _ in self._waiting:
            done: Done = Future()
            tip: list[Action] = []
            if isinstance(item, Exposure):
                self.worked += 1
                tip.append(Publish("needle/tip", m.Point(item.stamp_ns, "rig", (0.0, 0.0, 0.0))))
            if self.fails:
                done.set_exception(ValueError("cannot see"))
            else:
                done.set_result(tip)
            yield Send(EYES, (done,))
        self._waiting = []


def test_exposures_that_come_too_fast_are_lost_and_tips_come_back() -> None:
    rig, eyes = Rig(), SlowEyes()
    VirtualRunner([rig, eyes, DistantTracker()]).run(10.0)
    assert rig.exposed == pytest.approx(100, abs=2)
    # Two wait whenever work begins.
    assert eyes.worked == pytest.approx(40, abs=4)
    assert len(rig.tips) == pytest.approx(eyes.worked, abs=4)


def test_what_fails_there_is_named_here_and_ends_nothing() -> None:
    rig, eyes = Rig(), SlowEyes()
    runner = VirtualRunner([rig, eyes, DistantTracker()])
    eyes.fails = True
    runner.run(3.0)
    assert any("ValueError: cannot see" in text for text in rig.troubles)
    eyes.fails = False
    before = len(rig.tips)
    runner.run(3.0)
    assert len(rig.tips) > before


def test_without_the_process_that_works_there_is_no_rig() -> None:
    port = next(port for port in DistantTracker().ports if port.name == EYES)
    assert list(port.on_change(PortChange("it has ended"), Moment(1.0, 1))) == [
        Exit(1, "it has ended")
    ]
