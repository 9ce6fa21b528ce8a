"""Random steps of the driver on emulated drives, and faults at random moments of them."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from needle_core.can_frame import CAN
from needle_core.errors import UserError
from needle_sim.drive_emulator import POSITIONS
from needle_sim.drive_emulator_parameters import COUNTS_PER_RADIAN, DriveEmulatorParameters
from needle_sim.drives.power_state import PowerState
from scenario.virtual_rig import DRIVER, FASTEST, VirtualRig

INSERTION_COUNTS = DriveEmulatorParameters().insertion_counts_per_unit
_DEEPEST, _MOST_ROTATION = 0.19, 3.0
_STEP = 0.002
_CYCLE = 0.02
_CODES = (0x2310, 0x3210, 0x4210, 0x5530)
# A slow motor may be stalled for long before it is far off [s].
_NOTICED, _AFTER, _STILL = 5.0, 0.6, 0.3
_MOVING = ("HOLDING", "MOVING")


# ---- many steps ---------------------------------------------------------------------------------


def random_steps(count: int, seed: int = 1) -> dict[str, Any]:
    """Make random steps to the deepest, back, and again; tell where it all ended.

    Parameters
    ----------
    count : int
        How many steps, at least 2.
    seed : int
        Of the steps.

    Returns
    -------
    dict
        Figures; distances in counts of the encoders.
    """
    rng, rig = random.Random(seed), VirtualRig(seed)
    hand = rig.hand
    rig.home()
    rig.press()
    (insertion, rotation), begun = rig.place, rig.runner.now
    hand.heard.clear()
    retractions, memory, failures = 0, [], []
    for number in range(count):
        # From a hundredth of a mm up, as often in each decade.
        length = math.exp(rng.uniform(math.log(1e-5), math.log(_STEP)))
        turn = rng.uniform(-0.6, 0.6)
        turn = -turn if abs(rotation + turn) > _MOST_ROTATION else turn
        if insertion + length > _DEEPEST:
            rig.call("device/retract")
            rig.until(lambda: rig.hand.status.activity == "retraction", "a retraction")
            rig.until(lambda: rig.hand.status.activity == "none", "its end")
            rig.press()
            # It ends at the home switch, which may be a few counts before 0.
            retractions, insertion = retractions + 1, rig.place[0]
        insertion, rotation = insertion + length, rotation + turn
        # A count's rounding of where it begins must not make the fastest step too fast.
        duration = max(length / FASTEST, abs(turn) / 3.0) * rng.uniform(1.01, 1.5)
        stamp = rig.command(insertion, rotation, duration)
        rig.until(lambda stamp=stamp: stamp in hand.results, "the result of a step")  # type: ignore[misc]
        if hand.results[stamp] != "succeeded":
            failures.append(hand.results[stamp])
        # What this keeps itself would be taken for a leak.
        hand.places.clear()
        if number in (count // 10, count - 1):
            memory.append(_memory())
    rig.runner.run(0.1)
    at = rig.place
    cycles = math.floor((rig.runner.now - begun) / _CYCLE)
    return {
        "retractions": retractions,
        "failures": failures,
        "results": len(hand.results),
        "off_counts": (
            (at[0] - insertion) * INSERTION_COUNTS,
            (at[1] - rotation) * COUNTS_PER_RADIAN,
        ),
        "silent_cycles": cycles - min(hand.heard["joint_states"], hand.heard[POSITIONS]),
        "growth_MB": (memory[-1] - memory[0]) / 1e6,
    }


def _memory() -> int:
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


# ---- faults -------------------------------------------------------------------------------------


FAULTS: Mapping[str, Callable[[VirtualRig, str, random.Random], None]] = {
    "cut_bus": lambda rig, *_: setattr(rig.bus, "is_cut", True),
    "unplug": lambda rig, *_: rig.runner.lose_port(DRIVER, CAN, "unplugged"),
    "stall": lambda rig, axis, _: rig.bus.stall(axis),
    "reboot": lambda rig, axis, _: rig.bus.reboot(axis, rig.runner.now),
    "emcy": lambda rig, axis, rng: rig.bus.emergency(axis, rng.choice(_CODES)),
    "hang": lambda rig, axis, _: rig.bus.hang(axis),
    "kill_driver": lambda rig, *_: rig.runner.kill(DRIVER),
}


def fault_trials(kind: str, count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Return what came of faults of a kind, one after the other on one rig."""
    rig = VirtualRig(seed)
    rig.home()
    return [_fault(rig, kind, random.Random(f"{kind} {number}")) for number in range(count)]


class _Steps:
    """Sends the next step when the last has ended, as the controller does, whatever it came to."""

    def __init__(self, rig: VirtualRig, rng: random.Random) -> None:
        self._rig = rig
        self.speed = rng.uniform(0.0005, FASTEST)
        turn = rng.choice((-1.0, 1.0)) * rng.uniform(0.3, 1.0)
        self._turn = turn * min(3.0 * _STEP / self.speed, 1.0)
        self.turn_rate = abs(self._turn) * self.speed / _STEP
        self._stamp: int | None = None

    def go_on(self, seconds: float) -> None:
        """Keep a step under way for so long [s]."""
        rig = self._rig
        end = rig.runner.now + seconds
        while rig.runner.now < end:
            if self._stamp is None or self._stamp in rig.hand.results:
                insertion, rotation = rig.hand.joints
                turn = -self._turn if abs(rotation + self._turn) > _MOST_ROTATION else self._turn
                self._stamp = rig.command(
                    insertion + 0.999 * _STEP, rotation + turn, 1.01 * _STEP / self.speed
                )
            rig.runner.run(0.005)


def _fault(rig: VirtualRig, kind: str, rng: random.Random) -> dict[str, Any]:
    """Let it happen at a random moment of a random motion, watch, recover."""
    axis = rng.choice(("insertion", "rotation"))
    rig.press()
    steps = _Steps(rig, rng)
    steps.go_on(rng.uniform(0.1, 0.6))
    begun_at = rig.place[0]
    FAULTS[kind](rig, axis, rng)
    give_up = rig.runner.now + _NOTICED
    while rig.hand.status.state in _MOVING and rig.runner.now < give_up:
        if kind == "kill_driver":
            break
        steps.go_on(0.01)
    steps.go_on(_AFTER)
    stopped = rig.place[0]
    state, why = rig.hand.status.state, rig.hand.status.fault
    if kind == "kill_driver":
        # Nobody is left to say why, but the drives.
        faulted = [drive.state is PowerState.FAULT for drive in rig.bus.drives.values()]
        state, why = ("FAULT", "both drives") if all(faulted) else ("", "")
    still_from = len(rig.hand.places)
    steps.go_on(_STILL)
    try:
        _put_right(rig, kind)
        moved = max(abs(place[0] - stopped) for place in rig.hand.places[still_from:])
        trouble = _recover(rig)
    except UserError as error:
        moved, trouble = 0.0, str(error)
    return {
        "axis": axis,
        "speed": steps.speed,
        "turn_rate": steps.turn_rate,
        "distance": stopped - begun_at,
        "why": why if state == "FAULT" else "",
        "moved": moved,
        "trouble": trouble,
    }


def _put_right(rig: VirtualRig, kind: str) -> None:
    """End the fault, release, reset, enable, press: nothing of it moves the needle."""
    if kind == "kill_driver":
        rig.start_driver()
        rig.until(lambda: rig.hand.status.state in ("DISABLED", "FAULT"), "configured")
    rig.bus.restore(rig.runner.now)
    rig.runner.open_port(DRIVER, CAN)
    rig.release()
    if rig.hand.status.state != "DISABLED":
        rig.call("device/reset")
        rig.until(lambda: rig.hand.status.state == "DISABLED", "disabled")
    rig.call("device/enable", True)
    rig.press()
    rig.runner.run(_STILL)


def _recover(rig: VirtualRig) -> str:
    """Retract and home if need be, make a step, go back out; return what went wrong."""
    if not rig.hand.status.homed:
        _retract(rig)
        rig.call("device/enable", False)
        rig.home()
        rig.press()
    before, (insertion, rotation) = rig.place, rig.hand.joints
    stamp = rig.command(insertion + 2e-4, rotation + 0.1, 0.1)
    rig.until(lambda: stamp in rig.hand.results, "the end of a step")
    rig.runner.run(0.06)
    way = rig.place[0] - before[0]
    _retract(rig)
    if rig.hand.results[stamp] != "succeeded":
        return rig.hand.results[stamp]
    return "" if abs(way - 2e-4) <= 2.0 / INSERTION_COUNTS else f"0.2 mm went {way * 1e3:.5f} mm"


def _retract(rig: VirtualRig) -> None:
    rig.call("device/retract")
    rig.runner.run(_STILL)
    rig.until(lambda: rig.hand.status.activity == "none", "the retraction")
    rig.release()
