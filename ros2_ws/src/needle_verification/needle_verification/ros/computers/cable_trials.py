"""A rig on two computers, and the cable between them: each trial printed as one JSON object.

`python -m needle_verification.ros.computers.cable_trials 50`

Controller, cameras and the person who holds are on one computer, the driver and its drives on the
other; each is a network namespace of this machine, with shared memory of its own. All that goes
between them takes 5 ms, 1 % of it is lost, and in each trial the cable is cut at a random moment
for 0.1 to 5 s, while the person goes on holding. With `--clock-ahead` the cameras stamp by a clock
that is so far ahead of the driver's.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState

from needle_bringup.simulation.rig_configuration import REAL_TIME_WATCHDOG
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_common.commands.cli import EXIT_DONE, run_command
from needle_common.commands.options import CommandParser
from needle_common.process.reach import DISCOVERY_RANGE, PROFILES, keep_to_this_machine
from needle_common.process.ros_domain import own_domain
from needle_common.ros.conversions import LATCHED, RELIABLE, values_of
from needle_common.ros.partner_clocks import PART
from needle_verification.ros.holds.hold_trials import hold_anew
from needle_verification.ros.holds.hold_witness import HoldWitness
from needle_verification.trials.light import Light
from needle_verification.trials.namespaces import Cable, Computer, enter_network
from needle_verification.trials.piped_pedal import PipedPedal
from needle_verification.trials.trial_processes import (
    Parameters,
    TrialProcesses,
    drives_and_driver,
    without_recorder,
)

DELAY, LOSS = 0.005, 0.01
SHORTEST, LONGEST = 0.1, 5.0
_DRIVER = "/device_driver"
_OPERATOR, _CAMERAS = "operator", "stereo_tracker"
_PIPED = "needle_verification.ros.holds.piped_operator"
_TIP_CAMERA = "needle_verification.ros.computers.tip_camera"
_KEY = 48
_SPEED = 0.005  # [m/s], the fastest there is
_DEPTH_MM = 190.0
_DEEP = 0.17  # from here on the next trial has a rig of its own [m]
_READY = 60.0
# The latest moment of a cut after the needle moves, and how long what comes back is watched [s].
_LATEST, _BACK = 0.4, 2.0
# A needle that moved so shortly before moves now [s].
_RECENT = 0.05
# After so long without motion the next one is another [s].
_REST = 0.1


class _DriveWitness(HoldWitness):
    """Beside the drives; what they say of themselves is where the needle is."""

    def __init__(self, light: Light) -> None:
        self._light = light
        # Whose hold counted, one after the other.
        self.holders: list[str] = []
        super().__init__("sim/drive_positions")
        # What the controller says of the clocks of others.
        self.clocks: dict[str, str] = {}
        self.create_subscription(DiagnosticStatus, "device/status", self._on_status, LATCHED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_health, RELIABLE)

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.holders.append(values_of(message)["hold_owner"])

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f"plane_controller: {PART}":
                self.clocks = values_of(status)

    def clock_of(self, node: str) -> tuple[float, float]:
        """Return how far a node's clock is ahead of the controller's, and within what [s].

        Raises
        ------
        UserError
            If the controller does not say.
        """
        ahead, within = f"{node} ahead_s", f"{node} within_s"
        self.until(lambda: bool(self.clocks.get(ahead)), f"the clock of {node}")
        return float(self.clocks[ahead]), float(self.clocks[within])

    def end_of_motion(self, begin: float) -> tuple[float, float]:
        """Return when the needle came to rest after a time [s], and how far it went later [m]."""
        end = begin
        for at, _ in self._motions(begin, math.inf):
            if at.time - end > _REST:
                break
            end = at.time
        return end, self.way(end, math.inf)

    def _on_joints(self, message: JointState, info: dict[str, int]) -> None:
        super()._on_joints(message, info)
        insertion, rotation = message.position
        self._light.joints = insertion, rotation


@dataclasses.dataclass
class _Rig:
    """What a trial works with."""

    witness: _DriveWitness
    graph: TrialProcesses
    pedal: PipedPedal
    cable: Cable


def cable_trials(
    folder: Path, count: int, seed: int, longest: float = LONGEST, ahead: float = 0.0
) -> Iterator[dict[str, Any]]:
    """Yield what came of each cut; this process is on the computer of the drives from now on.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    count : int
        How many cuts.
    seed : int
        Of moments, lengths and losses.
    longest : float
        The longest cut [s].
    ahead : float
        How far the clock that the cameras stamp by is ahead [s].

    Raises
    ------
    UserError
        If no second computer can be made here.
    """
    rng = random.Random(seed)
    with _computers(seed) as computers:
        numbers = iter(range(count))
        number = next(numbers, None)
        while number is not None:
            place = folder / f"from_{number}"
            place.mkdir()
            with ExitStack() as held:
                rig = _rig(held, place, computers, ahead)
                hold_anew(rig.pedal, rig.witness)
                while number is not None and rig.witness.insertion < _DEEP:
                    yield {"number": number, **_cut(rig, rng, longest)}
                    rig.graph.check()
                    number = next(numbers, None)


@dataclasses.dataclass
class _Computers:
    """The person's computer, and the cable that leads to the one where this process is."""

    domain: int
    persons: Computer
    cable: Cable


@contextmanager
def _computers(seed: int) -> Iterator[_Computers]:
    """Make two computers and a bad cable; this process is on that of the drives from now on."""
    with ExitStack() as held:
        domain = held.enter_context(own_domain())
        persons, drives = (held.enter_context(closing(Computer())) for _ in range(2))
        cable = Cable((persons, drives), delay=DELAY, loss=LOSS, seed=seed)
        held.enter_context(closing(cable))
        enter_network(drives.pid)
        # What a person sets on both computers; the rest follows from it.
        os.environ[DISCOVERY_RANGE] = "SUBNET"
        os.environ.pop(PROFILES, None)
        keep_to_this_machine()
        rclpy.init(args=[], domain_id=domain)
        held.callback(rclpy.try_shutdown)
        yield _Computers(domain, persons, cable)


def _rig(held: ExitStack, folder: Path, computers: _Computers, ahead: float) -> _Rig:
    """Start the nodes where they belong, and make them ready."""
    light_file, pedal_file = folder / "light", folder / "pedal"
    witness = held.enter_context(
        closing(_DriveWitness(held.enter_context(closing(Light(light_file)))))
    )
    pedal = PipedPedal(pedal_file, _KEY)
    held.callback(pedal.unplug)
    before = dict.fromkeys((_OPERATOR, _CAMERAS, "plane_controller"), computers.persons.inside)
    graph = held.enter_context(
        closing(TrialProcesses(folder, computers.domain, _parameters(), before=before))
    )
    seen = {"light": str(light_file), "clock_ahead": ahead}
    graph.start_module(_CAMERAS, _TIP_CAMERA, seen)
    values = {"source": "pedal", "device": str(pedal_file), "key": _KEY}
    graph.start_module(_OPERATOR, _PIPED, values)
    witness.prepare(_READY)
    witness.clock_of(_DRIVER)
    return _Rig(witness, graph, pedal, computers.cable)


def _cut(rig: _Rig, rng: random.Random, longest: float) -> dict[str, Any]:
    """Cut the cable at a random moment, mend it with the hold still pressed, watch, press anew."""
    witness = rig.witness
    witness.pause(rng.uniform(0.0, _LATEST))
    length = rng.uniform(SHORTEST, longest)
    if witness.way(time.time() - _RECENT, math.inf) == 0.0:
        # A busy machine lets a path run out, or a hold.
        hold_anew(rig.pedal, witness)
    ahead, within = witness.clock_of(_DRIVER)
    del witness.holders[:]
    cut = time.time()
    rig.cable.cut()
    witness.pause(length)
    rig.cable.mend()
    witness.pause(_BACK)
    end, resumed = witness.end_of_motion(cut)
    outcome = {
        "clock_ahead_s": ahead,
        "clock_within_s": within,
        "length_s": length,
        "moving": witness.way(cut - _RECENT, cut) > 0.0,
        # A hold that went on counting was not lost.
        "lost": set(witness.holders) != {_OPERATOR},
        "last_motion_ms": (end - cut) * 1e3,
        "distance_mm": witness.way(cut, end) * 1e3,
        "resumed_mm": resumed * 1e3,
    }
    begin = time.monotonic()
    hold_anew(rig.pedal, witness)
    return {**outcome, "again_s": time.monotonic() - begin}


def _parameters() -> Parameters:
    # A needle that rests after each step would be at rest at many cuts.
    options = SimulateOptions(
        level="tip", controller="paper", insertion="continuous", depth_mm=_DEPTH_MM
    )
    controller = without_recorder(options)["plane_controller"]
    controller |= {
        "use_sim_time": False,
        "nominal_speed": _SPEED,
        "tip_covariance": "configured",
    }
    # The drives' bus is not what is tried: a machine that is busy otherwise must not cut it.
    patient = {"watchdog": REAL_TIME_WATCHDOG, "reply_age_limit": REAL_TIME_WATCHDOG}
    return {**drives_and_driver({}, patient), "plane_controller": controller}


def main() -> int:
    """Run trials; returns the exit code."""
    parser = CommandParser("cable_trials", __doc__ or "", "")
    parser.add_argument("count", type=int, help="how many cuts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest", type=float, default=LONGEST, help="the longest cut [s]")

    parser.add_argument("--clock-ahead", type=float, default=0.0, help="the cameras' clock [s]")

    def run() -> int:
        given = parser.parse_args()
        with tempfile.TemporaryDirectory(prefix="needle_trial_") as name:
            for outcome in cable_trials(
                Path(name), given.count, given.seed, given.longest, given.clock_ahead
            ):
                print(json.dumps(outcome), flush=True)
        return EXIT_DONE

    return run_command(run)


if __name__ == "__main__":
    sys.exit(main())
