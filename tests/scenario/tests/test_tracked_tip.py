"""A tracker steers the simulated needle; bad streams and bad registrations do not move it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from plus_messages import message, transform_message

from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import COMPUTE, make_rig, settings_of
from needle_bringup.simulated_operator.component import (
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_core import messages as m
from needle_core.commands.cli import EXIT_DONE
from needle_core.component import Output
from needle_core.runners.virtual import DIAGNOSTICS, VirtualRunner
from needle_sim.needle.bench import SimulatedBench
from needle_sim.sensors import Sensor
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.tracked.registration import Registration
from needle_tracker.tracked_tip import TrackedTip, TrackedTipParameters
from scenario.parts.simulated_tracker import PLACE, TURN, SimulatedTracker, TrackerModel

OPERATOR = SimulatedOperator.name
EXACT = Registration(
    translation=PLACE,
    quaternion=TURN.as_quat(),
    centroid=np.array([0.0, 0.0, 0.05]),
    covariance=np.diag([1e-8] * 3 + [1e-6] * 3),
    tip_offset=np.zeros(3),
    sensor_std=0.3e-3,
)
WRONG_BY = np.array([0.6e-3, -0.5e-3, 0.62e-3])
WRONG = dataclasses.replace(
    EXACT, translation=PLACE + WRONG_BY, covariance=np.diag([0.33e-6] * 3 + [2.5e-5] * 3)
)
BEHIND = dataclasses.replace(EXACT, tip_offset=np.array([0.0, 0.0, 8e-3]))


class NoSensor:
    outputs, ports, half_sizes = (), (), (math.inf, math.inf)

    def expose(self, number: int, stamp_ns: int) -> tuple[()]:
        return ()

    def close(self) -> None: ...


class TrackedRig:
    """The rig of level `tip` with a tracker as its sensor."""

    def __init__(
        self, tracker: SimulatedTracker, registration: Registration = EXACT, **settings: Any
    ) -> None:
        def see(bench: SimulatedBench, _: SimRigParameters) -> Sensor:
            tracker.bench = bench
            return NoSensor()

        parameters = command_line_parameters(parse(["--level", "tip"]), Path("none"))
        rig = make_rig(parameters, see=see)
        operator = settings_of(SimulatedOperatorParameters, parameters, OPERATOR)
        tracked = TrackedTip(TrackedTipParameters(**settings), registration)
        self.tracker, self.target = tracker, rig[-1].settings.target_offset
        self.tips: list[m.PoseWithCovariance] = []
        self.health: dict[str, str] = {}
        parts = [*rig, SimulatedOperator(operator), tracker, tracked]
        self.runner = VirtualRunner(parts, 3, compute=COMPUTE, taps=(self._note,))

    def _note(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        if output.topic == "needle/tip_pose":
            self.tips.append(message)
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

    def normalised_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the squared errors of position and heading over their claimed covariances."""
        times = np.array(sorted(self.tracker.truth))
        errors = []
        for tip in self.tips:
            nearest = times[np.argmin(np.abs(times - tip.stamp_ns))]
            truth, covariance = self.tracker.truth[nearest], np.reshape(tip.covariance, (6, 6))
            off = np.array(tip.position) - truth[:3, 3]
            turned = Rotation.from_quat(tip.orientation).as_matrix()[:, 2]
            turn = np.cross(truth[:3, 2], turned)
            errors.append(
                [v @ np.linalg.solve(c, v) for v, c in ((off, covariance[:3, :3]), (turn, covariance[3:, 3:]))]
            )
        return tuple(np.array(errors).T)


CASES = {
    "40 Hz": (TrackerModel(), EXACT, {}),
    "2 Hz": (TrackerModel(rate=2.0), EXACT, {}),
    "drop-outs": (TrackerModel(rate=10.0, lost=0.4), EXACT, {}),
    "late stamps": (TrackerModel(rate=10.0, is_late=True), EXACT, {"latency": 0.2}),
    "sensor behind the tip": (TrackerModel(rate=10.0, offset=8e-3), BEHIND, {}),
    "registration wrong by 1 mm": (TrackerModel(rate=10.0), WRONG, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_tracker_steers_the_needle_into_the_plane(case: str) -> None:
    model, registration, settings = CASES[case]
    rig = TrackedRig(SimulatedTracker(model, 1), registration, **settings)
    assert rig.run(400.0) == EXIT_DONE
    assert abs(rig.tracker.bench.tip[0] - rig.target) < 1e-3
    of_position, of_heading = rig.normalised_errors()
    print(case, rig.runner.now, 1e3*(rig.tracker.bench.tip[0] - rig.target), len(of_position), of_position.mean()/3, of_heading.mean()/2, rig.health)
    # Mean of chi-squared with three and two degrees of freedom, 1 by 1.
    assert 0.7 < np.mean(of_position) / 3.0 < 1.1
    assert 0.7 < np.mean(of_heading) / 2.0 < 1.1
