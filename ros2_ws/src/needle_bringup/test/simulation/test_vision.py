"""Cameras and tracker behind a port: what is handed on, what comes back, what is lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

from needle_bringup.simulation import vision
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.vision import EYES, DistantTracker, Eyes, EyesProcess
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

PARAMETERS = command_line_parameters(parse(["--level", "camera"]), Path())
STRAIGHT = {"pitch": 0.0, "roll": 0.0, "torsion_play": 0.0, "torsion_lag": 0.0, "tip_noise": 0.0}
FIRST = Exposure.of(SimulatedBench(curvature=1.0 / 0.122, seed=1, **STRAIGHT), 0, 1_000_000_000)
EXPOSURE_PERIOD = 0.1


def joints(insertion: float, stamp_ns: int) -> m.JointState:
    return m.JointState(stamp_ns, (m.INSERTION_JOINT,), (insertion,))


class PlayedPool:
    """Works in this process, at once; once it has ended it takes nothing."""

    def __init__(self, begin: Callable[..., None], *given: object) -> None:
        begin(*given)
        self.is_broken = False

    def submit(self, work: Callable[..., Any], *given: object) -> Future[Any]:
        if self.is_broken:
            raise BrokenProcessPool
        done: Future[Any] = Future()
        done.set_result(work(*given))
        return done

    def shutdown(self, **_: object) -> None:
        self.is_broken = True


@pytest.fixture(scope="module")
def process() -> Iterator[tuple[EyesProcess, list[Any]]]:
    """Return cameras and tracker as in their process, and what has arrived from there."""
    arrived: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "start_worker", PlayedPool)
        made = EyesProcess(PARAMETERS)
        made.open(arrived.append)
        Eyes.work(FIRST, Moment(0.0, 1))
        yield made, arrived


def test_an_exposure_becomes_images_and_a_tip_near_the_truth(
    process: tuple[EyesProcess, list[Any]],
) -> None:
    eyes, arrived = process
    bench = SimulatedBench(curvature=1.0 / 0.122, seed=1, **STRAIGHT)
    bench.move_to(0.05, 0.0)
    seen = Exposure.of(bench, 3, 4_000_000_000)
    at = Moment(3.0, seen.stamp_ns)
    around = [joints(0.05, seen.stamp_ns + late) for late in (0, 1)]
    eyes.send([(seen, at), *((item, at) for item in around), (None, at)])
    actions: list[Action] = [action for batch in arrived for action in batch[0].result()]
    sent = {action.topic: action.message for action in actions if isinstance(action, Publish)}
    assert {"stereo/left/image_raw", "stereo/right/camera_info"} <= sent.keys()
    assert sent["needle/tip"].position == pytest.approx(tuple(seen.T_rig_tip[:3, 3]), abs=5e-4)
    eyes.close()
    eyes.send([(None, at)])
    (lost,) = [batch for batch in arrived if isinstance(batch, PortChange)]
    (port,) = (port for port in DistantTracker().ports if port.name == EYES)
    assert list(port.on_change(lost, at)) == [Exit(1, lost.lost)]
    assert "has ended" in lost.lost


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
        yield Publish("joint_states", joints(0.0, at.stamp_ns))
        yield Send(CAMERAS, (dataclasses.replace(FIRST, number=self.exposed),))
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
            done: vision.Done = Future()
            seen = isinstance(item, Exposure)
            self.worked += seen
            tip = Publish("needle/tip", m.Point(at.stamp_ns, "rig", (0.0, 0.0, 0.0)))
            if self.fails:
                done.set_exception(ValueError("cannot see"))
            else:
                done.set_result([tip] if seen else [])
            yield Send(EYES, (done,))
        self._waiting = []


def test_exposures_that_come_too_fast_are_lost_and_what_fails_ends_nothing() -> None:
    rig, eyes = Rig(), SlowEyes()
    runner = VirtualRunner([rig, eyes, DistantTracker()])
    runner.run(10.0)
    assert rig.exposed == pytest.approx(100, abs=2)
    # Two wait whenever work begins.
    assert eyes.worked == pytest.approx(40, abs=4)
    assert len(rig.tips) == pytest.approx(eyes.worked, abs=4)
    eyes.fails = True
    runner.run(3.0)
    assert any("ValueError: cannot see" in text for text in rig.troubles)
    eyes.fails = False
    before = len(rig.tips)
    runner.run(3.0)
    assert len(rig.tips) > before
