"""Faults at random moments of random motions: how they end, and what it takes to go on."""

from __future__ import annotations

import contextlib
import random
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from campaign.trials.drives.drive_hand import INSERTION_COUNT, DriveHand
from campaign.trials.trial_processes import TrialProcesses, drives_and_driver
from campaign.trials.trial_runner import Outcomes, Trial
from needle_core.errors import UserError
from needle_core.message_types import NANOSECONDS

AXES = ("insertion", "rotation")
FAULTS = ("cut_bus", "unplug", "stall", "reboot", "emcy", "hang", "kill_driver")
_MOST_ROTATION = 3.0
_STEP = 0.002
_FAST = 0.005
_AFTER_FAULT = 0.6
_LONGEST = 5.0
_STARVED = 5
_STILL = 0.3


def fault_trials(
    folder: Path, domain: int, trials: Iterable[Trial], watchdog: float | None = None
) -> Outcomes:
    """Yield what came of each trial, in real time.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Their kinds are of `FAULTS`.
    watchdog : float, optional
        How long driver and drives wait for each other, in place of the driver's defaults [s].
    """
    driver = {"retraction_speed": _FAST}
    if watchdog is not None:
        driver |= {"watchdog": watchdog, "reply_age_limit": watchdog}
    parameters = drives_and_driver({}, driver)
    with (
        contextlib.closing(DriveHand()) as hand,
        contextlib.closing(TrialProcesses(folder, domain, parameters)) as processes,
    ):
        hand.until(hand.ready, "the driver", 60.0)
        _get_ready(hand)
        for trial in trials:
            yield trial.outcome(_fault(processes, hand, trial.kind, trial.rng))
            processes.check()


def _start_over(hand: DriveHand) -> None:
    """Bring the bench back to order after a trial that went wrong."""
    hand.release()
    hand.insist("reset")
    hand.insist("enable", True)
    hand.press()
    hand.pause(_STILL)
    _retract(hand)
    hand.release()
    hand.insist("enable", False)
    _get_ready(hand)


def _get_ready(hand: DriveHand) -> None:
    """Needle out, homed, enabled; not held."""
    hand.home()
    hand.insist("enable", True)


class _Stream:
    """Sends the next step when the last has ended, as the controller does, whatever it came to."""

    def __init__(self, hand: DriveHand, rng: random.Random) -> None:
        self._hand = hand
        self.speed = rng.uniform(0.0005, _FAST)
        turn = rng.choice((-1.0, 1.0)) * rng.uniform(0.3, 1.0)
        self._turn = turn * min(3.0 * _STEP / self.speed, 1.0)
        self.turn_rate = abs(self._turn) * self.speed / _STEP
        self._stamp: int | None = None

    def keep_going(self) -> None:
        """Send a step if none is under way, and listen."""
        hand = self._hand
        if self._stamp is None or self._stamp in hand.results:
            insertion, rotation = hand.joints.position if hand.joints is not None else (0.0, 0.0)
            turn = -self._turn if abs(rotation + self._turn) > _MOST_ROTATION else self._turn
            self._stamp = hand.command(
                insertion + 0.999 * _STEP, rotation + turn, 1.01 * _STEP / self.speed
            )
        hand.look(0.005)


def _fault(
    processes: TrialProcesses, hand: DriveHand, kind: str, rng: random.Random
) -> dict[str, Any]:
    """Let it happen at a random moment of a random motion, watch, recover."""
    words = _words(kind, rng)
    stream = _move_until_moment(hand, rng)
    logged = len(processes.log("device_driver"))
    faults = processes.log("drive_emulator").count(": fault 0x")
    begun_at = _happen(processes, hand, kind, words)
    # A slow motor may be stalled for long before it is far off.
    give_up_at = time.monotonic() + _LONGEST
    while hand.status.get("state") in ("HOLDING", "MOVING") and time.monotonic() < give_up_at:
        stream.keep_going()
    # The motors' own time: on a starved machine the last that was heard may be old.
    end_ns = time.time_ns() + round(_AFTER_FAULT * NANOSECONDS)
    while hand.motors[-1].stamp_ns < end_ns:
        stream.keep_going()
        if time.monotonic() > give_up_at + _LONGEST:
            raise UserError("the drives tell no positions any more")
    stopped = hand.motors[-1]
    state, reason = hand.status.get("state", ""), hand.status.get("fault", "")
    log = processes.log("device_driver")[logged:]
    still_from = len(hand.motors)
    end = time.monotonic() + _STILL
    while time.monotonic() < end:
        stream.keep_going()
    try:
        _put_right(processes, hand, kind)
        hand.press()
        hand.pause(_STILL)
        trouble = ""
    except UserError as error:
        trouble = str(error)
    # Whatever was restored, released, reset, enabled and held: only a command moves.
    moved = max(abs(at.insertion - stopped.insertion) for at in hand.motors[still_from:])
    try:
        trouble = trouble or _recover(hand)
    except UserError as error:
        trouble = str(error)
    if trouble:
        with contextlib.suppress(UserError):
            _start_over(hand)
    return {
        "words": words,
        "speed_mm_s": stream.speed * 1e3,
        "turn_rate_rad_s": stream.turn_rate,
        "distance_mm": (stopped.insertion - begun_at) * 1e3,
        "state": state,
        "reason": reason,
        "logged": bool(reason) and reason in log,
        "drives_faulted": processes.log("drive_emulator").count(": fault 0x") - faults,
        "moved_by_itself_mm": moved * 1e3,
        "trouble_after": trouble,
    }


def _move_until_moment(hand: DriveHand, rng: random.Random) -> _Stream:
    """Press, and make steps until the moment has come."""
    for _ in range(_STARVED):
        with contextlib.suppress(UserError):
            hand.press()
            stream = _Stream(hand, rng)
            moment = time.monotonic() + rng.uniform(0.1, 0.6)
            while time.monotonic() < moment:
                stream.keep_going()
            if hand.status.get("state") in ("HOLDING", "MOVING"):
                return stream
        # Watchdogs trip on a machine that has no time for this: it was no trial.
        with contextlib.suppress(UserError):
            _start_over(hand)
    raise UserError(f"the machine is too slow for a trial: {hand.status.get('fault')}")


def _happen(processes: TrialProcesses, hand: DriveHand, kind: str, words: str) -> float:
    """Let it happen; return where the insertion axis was [m]."""
    if kind == "kill_driver":
        at = hand.motors[-1].insertion
        processes.kill("device_driver")
        hand.status = {}
        return at
    commands = len(_commanded(processes))
    processes.say(words)
    hand.until(lambda: len(_commanded(processes)) > commands, "the fault")
    # Where the emulator says that it came; what is heard here is older.
    return _commanded(processes)[-1]


def _commanded(processes: TrialProcesses) -> list[float]:
    """Return where the insertion axis was at each fault on command so far [m]."""
    found = re.findall(r"on command: .*, at (\S+) mm", processes.log("drive_emulator"))
    return [float(position) * 1e-3 for position in found]


def _words(kind: str, rng: random.Random) -> str:
    if kind in ("stall", "reboot", "hang"):
        return f"{kind} {rng.choice(AXES)}"
    if kind == "emcy":
        return f"emcy {rng.choice(AXES)} 0x{rng.choice((0x2310, 0x3210, 0x4210, 0x5530)):04X}"
    return kind


def _put_right(processes: TrialProcesses, hand: DriveHand, kind: str) -> None:
    """End the fault, release, reset, enable."""
    if kind == "kill_driver":
        processes.start("device_driver")
        hand.until(hand.ready, "the driver", 60.0)
        hand.until(lambda: hand.status.get("state") in ("DISABLED", "FAULT"), "configured", 30.0)
    else:
        processes.say("restore")
        hand.pause(0.05)
    hand.release()
    if hand.status.get("state") != "DISABLED":
        hand.insist("reset")
        hand.until(lambda: hand.status.get("state") == "DISABLED", "disabled")
    hand.insist("enable", True)


def _recover(hand: DriveHand) -> str:
    """Retract and home if need be, make a step, go back out; return what went wrong."""
    if hand.status.get("homed") != "true":
        _retract(hand)
        hand.release()
        hand.insist("enable", False)
        _get_ready(hand)
        hand.press()
        hand.pause(_STILL)
    start = hand.motors[-1]
    joints = hand.joints
    assert joints is not None
    stamp = hand.command(joints.position[0] + 2e-4, joints.position[1] + 0.1, 0.1)
    hand.until(lambda: stamp in hand.results, "the end of a step")
    hand.pause(0.06)
    way = hand.motors[-1].insertion - start.insertion
    _retract(hand)
    hand.release()
    if hand.results[stamp] != "succeeded":
        return hand.results[stamp]
    if abs(way - 2e-4) > 2.0 * INSERTION_COUNT:
        return f"a step of 0.2 mm went {way * 1e3:.5f} mm"
    return ""


def _retract(hand: DriveHand) -> None:
    for _ in range(_STARVED):
        if hand.call("retract")[0]:
            break
        # A busy machine lets a hold lapse; the status tells so.
        hand.pause(_STILL)
        if hand.status.get("hold_owner") != hand.get_name():
            hand.press()
    else:
        hand.insist("retract")
    hand.until(lambda: hand.status.get("activity") == "none", "retracted", 60.0)
