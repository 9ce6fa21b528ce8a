"""A rig on two computers, and the cable between them: each trial printed as one JSON object.

`python -m campaign.trials.computers.cable_trials 50`

Controller, cameras and the person who holds are on one computer, the driver and its drives on the
other; each is a network namespace of this machine, with shared memory of its own. All that goes
between them takes 5 ms, 1 % of it is lost, and in each trial the cable is cut at a random moment
for 0.1 to 5 s, while the person goes on holding. With `--clock-ahead` the cameras stamp by a clock
that is so far ahead of the driver's.
"""

from __future__ import annotations

import dataclasses
import math
import os
import random
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState

from campaign.trials.computers.light import Light
from campaign.trials.computers.namespaces import Cable, Computer, enter_network
from campaign.trials.holds.hands import (
    LATEST,
    OPERATOR,
    READY,
    RECENT,
    PedalFoot,
    fast_insertion,
    hold_anew,
    until_deep,
)
from campaign.trials.holds.hold_witness import HoldWitness
from campaign.trials.listening_node import ros
from campaign.trials.trial_processes import (
    Parameters,
    TrialProcesses,
    drives_and_driver,
)
from campaign.trials.trial_runner import Outcomes, Trial, run_trials, trials_of
from needle_bringup.simulation.rig_configuration import GRAPH_WATCHDOG
from needle_core.commands.options import CommandParser
from needle_core.process.reach import DISCOVERY_RANGE, PROFILES, keep_to_this_machine
from needle_core.ros.conversions import LATCHED, values_of

KINDS = ("cut",)
DELAY, LOSS = 0.005, 0.01
SHORTEST, LONGEST = 0.1, 5.0
_CAMERAS = "stereo_tracker"
_TIP_CAMERA = "campaign.trials.computers.tip_camera"
# How long what comes back is watched [s].
_BACK = 2.0
# After so long without motion the next one is another [s]: a driver that a busy machine holds up
# for less goes on to the end of its stop after that.
_REST = GRAPH_WATCHDOG


class _DriveWitness(HoldWitness):
    """Beside the drives; what they say of themselves is where the needle is."""

    def __init__(self, light: Light) -> None:
        self._light = light
        # Whose hold counted, one after the other.
        self.holders: list[str] = []
        super().__init__("sim/drive_positions")
        self.create_subscription(DiagnosticStatus, "device/status", self._on_status, LATCHED)

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.holders.append(values_of(message)["hold_owner"])

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
    """Rig of a trial."""

    witness: _DriveWitness
    graph: TrialProcesses
    foot: PedalFoot


def cable_trials(
    folder: Path,
    domain: int,
    trials: Iterable[Trial],
    longest: float = LONGEST,
    ahead: float = 0.0,
) -> Outcomes:
    """Yield what came of each cut; this process is on the computer of the drives from now on.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Each a cut.
    longest : float
        The longest cut [s].
    ahead : float
        How far the clock that the cameras stamp by is ahead [s].

    Raises
    ------
    UserError
        If no second computer can be made here.
    """
    left = deque(trials)
    with _computers(left[0].rng.randrange(1000)) as (persons, cable), ros(domain):
        while left:
            with _rig(left[0].make_folder(folder), domain, persons, ahead) as rig:
                hold_anew(rig.foot, rig.witness)
                for trial in until_deep(left, rig.witness):
                    yield trial.outcome(_cut(rig, cable, trial.rng, longest))
                    rig.graph.check()


@contextmanager
def _computers(seed: int) -> Iterator[tuple[Computer, Cable]]:
    """Make the person's computer, and a bad cable to that of the drives, where this process is."""
    with closing(Computer()) as persons, closing(Computer()) as drives:
        cable = Cable((persons, drives), delay=DELAY, loss=LOSS, seed=seed)
        with closing(cable):
            enter_network(drives.pid)
            # What a person sets on both computers; the rest follows from it.
            os.environ[DISCOVERY_RANGE] = "SUBNET"
            os.environ.pop(PROFILES, None)
            keep_to_this_machine()
            yield persons, cable


@contextmanager
def _rig(folder: Path, domain: int, persons: Computer, ahead: float) -> Iterator[_Rig]:
    """Start the nodes where they belong, and make them ready."""
    light_file = folder / "light"
    before = dict.fromkeys((OPERATOR, _CAMERAS, "plane_controller"), persons.inside)
    with (
        closing(Light(light_file)) as light,
        closing(_DriveWitness(light)) as witness,
        closing(TrialProcesses(folder, domain, _parameters(), before=before)) as graph,
        closing(PedalFoot(folder, graph, witness)) as foot,
    ):
        seen = {"light": str(light_file), "clock_ahead": ahead}
        graph.start_module(_CAMERAS, _TIP_CAMERA, seen)
        witness.prepare(READY)
        yield _Rig(witness, graph, foot)


def _cut(rig: _Rig, cable: Cable, rng: random.Random, longest: float) -> dict[str, Any]:
    """Cut the cable at a random moment, mend it with the hold still pressed, watch, press anew."""
    witness = rig.witness
    witness.pause(rng.uniform(0.0, LATEST))
    length = rng.uniform(SHORTEST, longest)
    if witness.way(time.time() - RECENT, math.inf) == 0.0:
        # A busy machine lets a path run out, or a hold.
        hold_anew(rig.foot, witness)
    del witness.holders[:]
    cut = time.time()
    cable.cut()
    witness.pause(length)
    cable.mend()
    witness.pause(_BACK)
    end, resumed = witness.end_of_motion(cut)
    outcome = {
        "length_s": length,
        "moving": witness.way(cut - RECENT, cut) > 0.0,
        # A hold that went on counting was not lost.
        "lost": set(witness.holders) != {OPERATOR},
        "last_motion_ms": (end - cut) * 1e3,
        "distance_mm": witness.way(cut, end) * 1e3,
        "resumed_mm": resumed * 1e3,
    }
    begin = time.monotonic()
    hold_anew(rig.foot, witness)
    return {**outcome, "again_s": time.monotonic() - begin}


def _parameters() -> Parameters:
    controller = fast_insertion()["plane_controller"]
    controller |= {"tip_covariance": "configured"}
    # The drives' bus is not what is tried: a machine that is busy otherwise must not cut it.
    patient = {"watchdog": GRAPH_WATCHDOG, "reply_age_limit": GRAPH_WATCHDOG}
    return {**drives_and_driver({}, patient), "plane_controller": controller}


def main() -> int:
    """Run trials; returns the exit code."""
    parser = CommandParser("cable_trials", __doc__ or "", "")
    parser.add_argument("--longest", type=float, default=LONGEST, help="the longest cut [s]")
    parser.add_argument("--clock-ahead", type=float, default=0.0, help="the cameras' clock [s]")
    return run_trials(
        parser,
        lambda given, folder, domain: cable_trials(
            folder,
            domain,
            trials_of(KINDS, given.kinds, given.count, given.seed),
            given.longest,
            given.clock_ahead,
        ),
    )


if __name__ == "__main__":
    sys.exit(main())
