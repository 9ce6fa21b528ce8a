"""Cameras and tracker behind a port: passed, returned and lost messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

from needle_bringup.simulation import vision
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.vision import VISION, RemoteTracker, VisionProcess, VisionWorker
from needle_core import messages as m
from needle_core.component import Action, Exit, Moment, PortChange, Publish, Send
from needle_sim.cameras import CAMERAS, Exposure
from needle_sim.needle.bench import SimulatedBench

PARAMETERS = command_line_parameters(parse(["--level", "camera"]), Path())
STRAIGHT = {"pitch": 0.0, "roll": 0.0, "torsion_play": 0.0, "torsion_lag": 0.0, "tip_noise": 0.0}
AT = Moment(3.0, 4_000_000_000)


def exposure(insertion: float, stamp_ns: int = AT.stamp_ns) -> Exposure:
    bench = SimulatedBench(curvature=1.0 / 0.122, seed=1, **STRAIGHT)
    bench.move_to(insertion, 0.0)
    return Exposure.of(bench, 3, stamp_ns)


class PlayedPool:
    """Pool that works in this process at once; after its end it accepts nothing."""

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
def process() -> Iterator[tuple[VisionProcess, list[Any]]]:
    """Return cameras and tracker as in their process, and the received answers."""
    arrived: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vision, "start_worker", PlayedPool)
        made = VisionProcess(PARAMETERS)
        made.open(arrived.append)
        VisionWorker.work(exposure(0.0, 1), Moment(0.0, 1))
        yield made, arrived


def test_an_exposure_becomes_images_and_a_tip_near_the_truth(
    process: tuple[VisionProcess, list[Any]],
) -> None:
    (eyes, arrived), seen = process, exposure(0.05)
    around = [m.JointState(AT.stamp_ns + n, (m.INSERTION_JOINT,), (0.05,)) for n in (0, 1)]
    # With a known insertion, one pair is enough.
    eyes.send([(item, AT) for item in (*around, seen, None)])
    actions: list[Action] = [action for batch in arrived for action in batch[0].result()]
    sent = {action.topic: action.message for action in actions if isinstance(action, Publish)}
    assert {"stereo/left/image_raw", "stereo/right/camera_info"} <= sent.keys()
    assert sent["needle/tip"].position == pytest.approx(tuple(seen.T_rig_tip[:3, 3]), abs=5e-4)
    eyes.close()
    eyes.send([(None, AT)])
    (lost,) = [batch for batch in arrived if isinstance(batch, PortChange)]
    (port,) = (port for port in RemoteTracker().ports if port.name == VISION)
    assert list(port.on_change(lost, AT)) == [Exit(1, lost.lost)]
    assert "has ended" in lost.lost


def test_fast_exposures_are_dropped_and_failures_raised() -> None:
    tracker, seen = RemoteTracker(), exposure(0.0)
    hand_on = {port.name: port.handler for port in tracker.ports}
    (row,), (timer,) = tracker.inputs, tracker.timers
    joints = m.JointState(AT.stamp_ns, (m.INSERTION_JOINT,), (0.0,))
    sent = list(hand_on[CAMERAS]((seen, seen, seen), AT))
    assert sent == [Send(VISION, ((seen, AT),))] * 2
    # Joint states and time are never dropped.
    sent = [*row.handler(joints, AT), *timer.handler(AT)]
    assert [action.batch[0][0] for action in sent if isinstance(action, Send)] == [joints, None]
    assert list(hand_on[CAMERAS]((seen,), AT)) == []
    tip = Publish("needle/tip", m.Point(AT.stamp_ns, "rig", (0.0, 0.0, 0.0)))
    done: vision.Done = Future()
    done.set_result([tip])
    assert list(hand_on[VISION]((done,), AT)) == [tip]
    failed: vision.Done = Future()
    failed.set_exception(ValueError("cannot see"))
    with pytest.raises(ValueError, match="cannot see"):
        list(hand_on[VISION]((failed,), AT))
    assert len(list(hand_on[CAMERAS]((seen, seen, seen), AT))) == 2
