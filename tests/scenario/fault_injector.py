"""Injects the faults of the vocabulary into the rig, and removes them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from collections.abc import Callable
from functools import partial
from typing import Any

from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.component import Call
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import from_values
from scenario import faults
from scenario.faults import Fault, Kind
from scenario.link_faults import LinkFault
from scenario.parts.bench import CameraState
from scenario.parts.rogue_publisher import RoguePublisher
from scenario.rig import SECOND_JOYSTICK, SECOND_OPERATOR, SoakRig
from scenario.schedule_runner import Undo

_LINKS = (*faults.TOPICS, *faults.SERVICES, faults.BUS, faults.PAGE_LINE)
SLOWEST_HANDLER = 0.05
"""Largest added time of a handler of a slow node [s]."""
LATEST_MESSAGE = 1.0
"""Largest delay of a message by a fault [s]."""
_LATEST_FRAME = 0.1
_JUMP_NS = 20_000_000_000
_DRIFT_NS, _DRIFT_PERIOD = 2_000_000, 0.02
# Time between two changes of an unsteady hand [s].
_TREMOR_PERIOD = (0.03, 0.3)
_HAND_STATES = ((True, False), (False, False), (False, True), (True, True))
_MOTION_ERROR = 0x5530
_CAMERA_STATES = {
    Kind.OFF: CameraState.BLACK,
    Kind.STUCK: CameraState.FROZEN,
    Kind.WRONG: CameraState.WRONG,
    Kind.SLOW: CameraState.LATE,
    Kind.GARBAGE: CameraState.WRONG,
}
_SWITCHED_ON = ("device/enable", "device/confirm_needle_out")


def _nothing() -> None:
    """No-op end of a fault without duration."""


class FaultInjector:
    """Begins and ends faults.

    Parameters
    ----------
    rig : SoakRig
        The rig.
    """

    def __init__(self, rig: SoakRig) -> None:
        self._rig = rig
        self._timeline = rig.runner.timeline
        self._rogues = itertools.count(1)
        self._injectors: dict[str, Callable[[Fault], Undo]] = {
            **dict.fromkeys(
                (*faults.PROCESSES, faults.CONSOLE, faults.RECORDER), self._inject_process_fault
            ),
            faults.DISK: self._inject_disk_fault,
            **dict.fromkeys(_LINKS, self._inject_link_fault),
            **dict.fromkeys(faults.DRIVES, self._inject_drive_fault),
            faults.ADAPTER: self._unplug,
            faults.PAGE: self._inject_page_fault,
            faults.CAMERAS: self._inject_camera_fault,
            faults.CLOCK: self._inject_clock_fault,
            faults.PERSON: self._inject_operator_error,
            faults.SECOND_PERSON: self._inject_second_operator,
            faults.PARAMETERS: self._change_parameters,
        }

    def begin(self, fault: Fault) -> Undo:
        """Begin a fault; return the function that ends it."""
        return self._injectors.get(fault.part, self._inject_rogue_publisher)(fault)

    def _chance_of(self, fault: Fault) -> random.Random:
        return self._timeline.stream(f"fault of {fault.part}")

    # ---- parts ----------------------------------------------------------------------------------

    def _inject_process_fault(self, fault: Fault) -> Undo:
        rig, names = self._rig, self._rig.processes_of(fault.part)
        if fault.kind is Kind.OFF:
            for name in names:
                rig.kill(name)

            def start() -> None:
                for name in names:
                    rig.start(name)

            return start
        for name in filter(rig.runner.runs, names):
            if fault.kind is Kind.STUCK:
                rig.runner.freeze(name, fault.lasts)
            else:
                rig.runner.slow_down(name, fault.lasts, fault.size * SLOWEST_HANDLER)
        return _nothing

    def _unplug(self, _: Fault) -> Undo:
        self._rig.unplug()
        return self._rig.plug_in

    def _inject_page_fault(self, fault: Fault) -> Undo:
        rig = self._rig
        if fault.kind is Kind.OFF:
            if rig.runner.runs(faults.PAGE):
                rig.runner.stop(faults.PAGE)
            return partial(rig.start, faults.PAGE)
        if fault.kind is Kind.STUCK:
            return self._inject_process_fault(fault)
        doing = "sends_garbage" if fault.kind is Kind.GARBAGE else "repeats"
        setattr(rig.page, doing, True)
        return lambda: setattr(rig.page, doing, False)

    def _inject_link_fault(self, fault: Fault) -> Undo:
        late = fault.size * (_LATEST_FRAME if fault.part == faults.BUS else LATEST_MESSAGE)
        fault_until_end = partial(LinkFault, self._timeline.now + fault.lasts)
        fault_on_link = {
            Kind.OFF: fault_until_end(loss=1.0),
            Kind.INTERMITTENT: fault_until_end(loss=fault.size),
            Kind.SLOW: fault_until_end(late=late),
            Kind.REORDERED: fault_until_end(late=late, reorders=True),
            Kind.DUPLICATED: fault_until_end(late=late, duplicates=0.5, reorders=True),
        }[fault.kind]
        self._rig.faults.begin(fault.part, fault_on_link)
        return partial(self._rig.faults.end, fault.part)

    def _inject_drive_fault(self, fault: Fault) -> Undo:
        axis, now = fault.part.partition(" ")[0], self._timeline.now
        bus = self._rig.drives.bus
        drive = bus.drives[axis]
        match fault.kind:
            case Kind.OFF:
                bus.reboot(axis, now)
            case Kind.GARBAGE:
                bus.fail(axis, _MOTION_ERROR)
            case Kind.STUCK:
                bus.stall(axis)
                return partial(setattr, drive.motor, "stalled", False)
            case _:
                bus.hang(axis)

                def resume() -> None:
                    drive.hung = False
                    drive.tick(self._timeline.now)

                return resume
        return _nothing

    def _inject_camera_fault(self, fault: Fault) -> Undo:
        self._rig.tracker.camera_state = _CAMERA_STATES[fault.kind]
        # The tracker may have been restarted by then.
        return lambda: setattr(self._rig.tracker, "camera_state", CameraState.CLEAR)

    def _inject_clock_fault(self, fault: Fault) -> Undo:
        timeline = self._timeline
        if fault.kind is Kind.WRONG:
            before = timeline.clock_offset_ns
            timeline.clock_offset_ns += round((fault.size - 0.5) * 2.0 * _JUMP_NS)
            return partial(setattr, timeline, "clock_offset_ns", before)

        def drift() -> None:
            timeline.clock_offset_ns -= round(fault.size * _DRIFT_NS)

        self._repeat(fault, drift, lambda: _DRIFT_PERIOD)
        return _nothing

    def _inject_operator_error(self, fault: Fault) -> Undo:
        person, hand = self._rig.person, self._rig.hand
        person.absent = True

        def toggle() -> None:
            hand.insert = not hand.insert

        if fault.kind is Kind.OFF:
            hand.insert = hand.retract = hand.stop = False
        elif fault.kind is Kind.INTERMITTENT:
            self._repeat(fault, toggle)
        elif fault.kind is Kind.WRONG:
            hand.insert, hand.retract = fault.size < 0.6, fault.size > 0.4
            hand.stop = fault.size > 0.9

        def end() -> None:
            person.absent = hand.stop = False

        return end

    def _inject_disk_fault(self, fault: Fault) -> Undo:
        assert self._rig.disk is not None, "the rig has no recorder"
        return self._rig.disk.spoil(fault)

    def _inject_second_operator(self, fault: Fault) -> Undo:
        rig, hand, chance = self._rig, self._rig.second_hand, self._chance_of(fault)

        def release() -> None:
            hand.insert = hand.retract = False

        def change_hand() -> None:
            hand.insert, hand.retract = chance.choice(_HAND_STATES)

        if fault.kind is Kind.INTERMITTENT:
            self._repeat(fault, change_hand)
            return release
        hand.insert, hand.retract = fault.kind is not Kind.WRONG, fault.kind is Kind.WRONG
        if fault.kind is not Kind.OFF:
            return release
        return partial(rig.kill, SECOND_JOYSTICK if fault.size < 0.5 else SECOND_OPERATOR)

    def _repeat(
        self, fault: Fault, act: Callable[[], None], pause: Callable[[], float] | None = None
    ) -> None:
        """Act now, and after each pause during a fault."""
        end, chance = self._timeline.now + fault.lasts, self._chance_of(fault)

        def act_and_reschedule() -> None:
            if self._timeline.now < end:
                act()
                seconds = pause() if pause else chance.uniform(*_TREMOR_PERIOD)
                self._timeline.call_after(seconds, act_and_reschedule)

        act_and_reschedule()

    def _change_parameters(self, fault: Fault) -> Undo:
        rig, values = self._rig, dataclasses.asdict(self._rig.steering)
        wrong = {
            "curvature": 4.0 + 10.0 * fault.size,
            "step_length": 5e-4 + 2e-3 * fault.size,
            "nominal_speed": 1e-3 + 1e-2 * fault.size,
            "depth": 0.03 * fault.size,
        }
        garbage = {"curvature": math.nan, "step_length": -1.0, "curvatur": 1.0, "depth": "deep"}
        choice: dict[str, Any] = wrong if fault.kind is Kind.WRONG else garbage
        name = self._chance_of(fault).choice(tuple(choice))
        named = {**values, name: choice[name]}
        try:
            changed = from_values(SteeringSettings, named, "plane_controller")
        except UserError:
            return _nothing

        def change_to(settings: SteeringSettings) -> None:
            if rig.runner.runs("plane_controller"):
                rig.runner.configure("plane_controller", settings)

        change_to(changed)
        return partial(change_to, rig.steering)

    # ---- rogue publishers -----------------------------------------------------------------------

    def _inject_rogue_publisher(self, fault: Fault) -> Undo:
        rig = self._rig
        if not faults.rogue_topic(fault):
            name = fault.part.removeprefix(faults.ROGUE).removeprefix("/")
            on = True if name in _SWITCHED_ON else None
            if name.endswith(" off"):
                name, on = name.removesuffix(" off"), False
            rig.person.extra_actions.append(Call(name, on))
            return _nothing
        name = f"stranger_{next(self._rogues)}"
        rig.runner.start(RoguePublisher(name, fault, rig.bench, self._chance_of(fault)))
        return partial(rig.runner.stop, name)
