"""A tracker steers the simulated needle; bad streams and bad registrations do not move it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bringup.simulated_operator.component import (
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import COMPUTE, make_rig, settings_of
from needle_core import messages as m
from needle_core.commands.cli import EXIT_DONE
from needle_core.component import Output, Port
from needle_core.runners.virtual import DIAGNOSTICS, VirtualRunner
from needle_sim.bench import SimulatedBench
from needle_sim.sensors import Sensor
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.optics.calibration import pose_matrix
from needle_tracker.tracked.registration import Registration
from needle_tracker.tracked_tip import TrackedTip, TrackedTipParameters
from plus_messages import message, transform_message
from scenario.parts.simulated_tracker import PLACE, TURN, SimulatedTracker, TrackerModel

Spoil = Callable[[int, np.ndarray, float], bytes]
OPERATOR = SimulatedOperator.name


def moved(turn: Rotation, place: np.ndarray) -> Registration:
    """Return the exact registration with another T_rig_tracker."""
    return dataclasses.replace(EXACT, T_rig_tracker=pose_matrix(turn.as_matrix(), place))


EXACT = Registration(
    T_rig_tracker=pose_matrix(TURN.as_matrix(), PLACE),
    centroid=np.array([0.0, 0.0, 0.05]),
    covariance=np.diag([1e-8] * 3 + [1e-6] * 3),
    tip_offset=np.zeros(3),
    sensor_std=0.3e-3,
)
WRONG_BY = np.array([0.6e-3, -0.5e-3, 0.62e-3])
WRONG = dataclasses.replace(
    moved(TURN, PLACE + WRONG_BY), covariance=np.diag([0.33e-6] * 3 + [2.5e-5] * 3)
)
BEHIND = dataclasses.replace(EXACT, tip_offset=np.array([0.0, 0.0, 8e-3]))


class NoSensor:
    outputs: tuple[Output, ...] = ()
    ports: tuple[Port, ...] = ()
    half_sizes = (math.inf, math.inf)

    def expose(self, number: int, stamp_ns: int) -> tuple[()]:
        return ()

    def close(self) -> None: ...


class TrackedRig:
    """The rig of level `tip` with a tracker as its sensor."""

    def __init__(
        self,
        tracker: SimulatedTracker,
        registration: Registration = EXACT,
        steering: Any = None,
        **settings: Any,
    ) -> None:
        def observe(bench: SimulatedBench, _: SimRigParameters) -> Sensor:
            tracker.bench = bench
            return NoSensor()

        parameters = command_line_parameters(parse(["--level", "tip"]), Path("none"))
        parameters["plane_controller"] |= steering or {}
        rig = make_rig(parameters, new_sensor=observe)
        operator = settings_of(SimulatedOperatorParameters, parameters, OPERATOR)
        tracked = TrackedTip(TrackedTipParameters(**settings), registration)
        self.tracker, self.target = tracker, rig[-1].settings.target_offset
        self.tips: list[m.PoseWithCovariance] = []
        self.estimates: list[m.PoseWithCovariance] = []
        self.health: dict[str, str] = {}
        parts = [*rig, SimulatedOperator(operator), tracker, tracked]
        self.runner = VirtualRunner(parts, 3, compute=COMPUTE, taps=(self._note,))

    def _note(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        if output.topic == "needle/tip_pose":
            self.tips.append(message)
        elif output.topic == "needle/estimate":
            self.estimates.append(message)
        elif output == DIAGNOSTICS and sender == TrackedTip.name:
            (status,) = message.statuses
            self.health = {**status.values, "message": status.text}

    @property
    def insertion(self) -> float:
        return self.tracker.bench.insertion

    def run(self, longest: float) -> int | None:
        """Run until the operator ends, or for a time [s]; return the operator's exit code."""
        while self.runner.now < longest and not self.runner.run(1.0):
            pass
        exits = self.runner.exits
        return exits[OPERATOR].code if OPERATOR in exits else None

    def normalized_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the squared errors of position and heading over their claimed covariances."""
        times = np.array(sorted(self.tracker.truth))
        errors = []
        for tip in self.tips:
            nearest = times[np.argmin(np.abs(times - tip.stamp_ns))]
            truth, covariance = self.tracker.truth[nearest], np.reshape(tip.covariance, (6, 6))
            off = np.array(tip.position) - truth[:3, 3]
            turned = Rotation.from_quat(tip.orientation).as_matrix()[:, 2]
            turn = np.cross(truth[:3, 2], turned)
            pairs = (off, covariance[:3, :3]), (turn, covariance[3:, 3:])
            errors.append([error @ np.linalg.solve(claim, error) for error, claim in pairs])
        return tuple(np.array(errors).T)

    def estimate_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of x over their claimed sigmas, and those of the heading [rad]."""
        times = np.array(sorted(self.tracker.truth))
        of_x, of_heading = [], []
        for estimate in self.estimates:
            truth = self.tracker.truth[times[np.argmin(np.abs(times - estimate.stamp_ns))]]
            off = estimate.position[0] - (truth[0, 3] - self.target)
            of_x.append(off / math.sqrt(estimate.covariance[0]))
            heading = Rotation.from_quat(estimate.orientation).as_matrix()[:, 2]
            of_heading.append(np.linalg.norm(heading - truth[:3, 2]))
        return np.array(of_x), np.array(of_heading)


CASES = {
    "40 Hz": (TrackerModel(), EXACT, {}),
    "2 Hz": (TrackerModel(rate=2.0), EXACT, {}),
    "drop-outs": (TrackerModel(rate=4.0, lost=0.4), EXACT, {}),
    "late stamps": (TrackerModel(rate=4.0, is_late=True), EXACT, {"latency": 0.2}),
    "sensor behind the tip": (TrackerModel(rate=4.0, offset=8e-3), BEHIND, {}),
    "registration wrong by 1 mm": (TrackerModel(rate=4.0), WRONG, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_tracker_steers_the_needle_into_the_plane(case: str) -> None:
    model, registration, settings = CASES[case]
    rig = TrackedRig(SimulatedTracker(model, 1), registration, **settings)
    assert rig.run(400.0) == EXIT_DONE
    assert abs(rig.tracker.bench.tip[0] - rig.target) < 1e-3
    of_position, of_heading = rig.normalized_errors()
    # Mean of chi-squared with three and two degrees of freedom, 1 by 1.
    assert 0.7 < np.mean(of_position) / 3.0 < 1.1
    assert 0.7 < np.mean(of_heading) / 2.0 < 1.2


def test_a_measured_heading_improves_the_estimate() -> None:
    early = []
    for measured in (False, True):
        steering = {
            "tip_covariance": "from_tip_pose",
            "measurement_std": 1e-4,
            "measured_heading": measured,
        }
        rig = TrackedRig(SimulatedTracker(TrackerModel(rate=4.0), 1), steering=steering)
        assert rig.run(400.0) == EXIT_DONE
        assert abs(rig.tracker.bench.tip[0] - rig.target) < 5e-4
        of_x, of_heading = rig.estimate_errors()
        assert np.mean(of_x**2) < 1.1
        early.append(np.sqrt(np.mean(of_heading[1:30] ** 2)))
    assert early[1] < 0.5 * early[0]


def of_matrix(change: Callable[[int, np.ndarray], Any]) -> Spoil:
    """Return a stream whose matrices [mm] are changed in place."""

    def spoil(number: int, matrix: np.ndarray, stamp: float) -> bytes:
        change(number, matrix)
        return transform_message(matrix, stamp)

    return spoil


def of_bytes(change: Callable[[bytes], bytes]) -> Spoil:
    return lambda _, matrix, stamp: change(transform_message(matrix, stamp))


def of_stamp(change: Callable[[float], float]) -> Spoil:
    return lambda _, matrix, stamp: transform_message(matrix, change(stamp))


def put(place: Any, value: Any) -> Spoil:
    return of_matrix(lambda _, matrix: matrix.__setitem__(place, value))


def times(*scales: float) -> Spoil:
    def scale(_: int, matrix: np.ndarray) -> None:
        matrix[:3, :3] *= scales

    return of_matrix(scale)


def displaced(by: Callable[[int], Any]) -> Spoil:
    """Return a stream whose sensor is displaced in `rig` [mm]."""

    def displace(number: int, matrix: np.ndarray) -> None:
        matrix[:3, 3] += TURN.inv().apply(by(number))

    return of_matrix(displace)


def stay_at_entry(_: int, matrix: np.ndarray) -> None:
    matrix[:3, :3] = TURN.inv().as_matrix()
    matrix[:3, 3] = -1e3 * TURN.inv().apply(PLACE)


RANDOM = np.random.default_rng(5)
BAD_STREAMS: dict[str, tuple[Spoil, str]] = {
    "NaN": (put((0, 3), math.nan), "not_finite"),
    "mirrored": (times(-1.0, 1.0, 1.0), "not_a_rotation"),
    "sheared": (put((0, 1), 0.9), "not_a_rotation"),
    "frozen": (of_matrix(stay_at_entry), "frozen"),
    "clock ahead": (of_stamp(lambda stamp: stamp + 0.5), "clock"),
    "clock behind": (of_stamp(lambda stamp: stamp - 1.5), "clock"),
    "30 mm aside": (displaced(lambda _: (30.0, 0.0, 0.0)), "out_of_range"),
    "two places": (displaced(lambda n: (3.0 * (n % 2), 0.0, 0.0)), "jump"),
    "reversed": (times(1.0, -1.0, -1.0), "heading"),
    "wrong bit": (of_bytes(lambda data: data[:-1] + bytes([data[-1] ^ 1])), "unreadable"),
    "noise on the line": (of_bytes(lambda data: RANDOM.bytes(len(data))), "unreadable"),
    "short body": (
        lambda _, matrix, stamp: message("TRANSFORM", "NeedleToTracker", stamp, bytes(40)),
        "unreadable",
    ),
    "out of volume": (
        lambda _, matrix, stamp: transform_message(matrix, stamp, status="OUT_OF_VOLUME"),
        "status",
    ),
    "another sensor": (
        lambda _, matrix, stamp: transform_message(matrix, stamp, "ProbeToTracker"),
        "no NeedleToTracker for 1 s, but ProbeToTracker",
    ),
    "nothing": (lambda *_: b"", "no NeedleToTracker for 1 s"),
}


@pytest.mark.parametrize("case", BAD_STREAMS)
def test_a_bad_stream_is_named_and_moves_nothing(case: str) -> None:
    spoil, name = BAD_STREAMS[case]
    rig = TrackedRig(SimulatedTracker(TrackerModel(rate=20.0), 1, spoil))
    rig.run(6.0)
    assert rig.tips == []
    assert rig.insertion == 0.0
    assert name in rig.health["message"] or int(rig.health[name]) > 20


@pytest.mark.parametrize("case", ["NaN", "frozen", "30 mm aside", "two places", "nothing"])
def test_a_stream_that_turns_bad_stops_the_needle(case: str) -> None:
    assert advance_after(BAD_STREAMS[case][0]) < 2.2e-3


def test_a_sensor_that_stays_behind_stops_the_needle() -> None:
    def stay(number: int, matrix: np.ndarray) -> None:
        held.setdefault("matrix", matrix[:3, 3].copy())
        matrix[:3, 3] = held["matrix"] + RANDOM.normal(0.0, 0.3, 3)

    held: dict[str, np.ndarray] = {}
    assert advance_after(of_matrix(stay)) < 8e-3


def advance_after(spoil: Spoil) -> float:
    """Return the insertion after a stream has turned bad [m]."""

    def spoil_later(number: int, matrix: np.ndarray, stamp: float) -> bytes:
        if number < 120:
            return transform_message(matrix, stamp)
        begun.setdefault("insertion", tracker.bench.insertion)
        return spoil(number, matrix, stamp)

    begun: dict[str, float] = {}
    tracker = SimulatedTracker(TrackerModel(rate=20.0), 1, spoil_later)
    rig = TrackedRig(tracker)
    rig.run(16.0)
    assert begun["insertion"] > 3e-3
    return rig.insertion - begun["insertion"]


QUARTER = Rotation.from_euler("y", 90.0, degrees=True)
BAD_REGISTRATIONS = {
    "10 mm off": (moved(TURN, PLACE + 6e-3), "out_of_range"),
    "w first": (moved(Rotation.from_quat(np.roll(TURN.as_quat(), 1)), PLACE), "out_of_range"),
    "turned about the entry": (moved(QUARTER * TURN, QUARTER.apply(PLACE)), "heading"),
}


@pytest.mark.parametrize("case", BAD_REGISTRATIONS)
def test_a_bad_registration_is_named_and_moves_nothing(case: str) -> None:
    registration, name = BAD_REGISTRATIONS[case]
    rig = TrackedRig(SimulatedTracker(TrackerModel(rate=20.0), 1), registration)
    rig.run(6.0)
    assert (rig.tips, rig.insertion) == ([], 0.0)
    assert int(rig.health[name]) > 20
