"""Model of the operator: prepares the rig, inserts, recovers from faults, withdraws the needle."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable

from needle_core import component as c
from needle_core import messages as m
from needle_core.status_messages import ControllerStatus, DeviceStatus

INSERT, RETRACT, STOP = 0, 1, 2
_PERIOD = 0.1
_JOY_RATE = 50.0
# Shortest time between two calls of one service [s].
_CALL_AGAIN = 0.5
# Pause between release and press, and time after which a press without effect is repeated [s].
_PAUSE, _RETRY_AFTER = 0.3, 3.0
OUT = 3e-4
"""Insertion up to which the needle looks withdrawn [m]."""


class OperatorGoal(enum.Enum):
    """Goal of the operator."""

    INSERT = "insert"
    WITHDRAW = "draw out"
    LEAVE = "leave"


@dataclasses.dataclass
class JoystickButtons:
    """Buttons of the joystick, true while pressed.

    Attributes
    ----------
    insert, retract, stop : bool
        One for each button.
    """

    insert: bool = False
    retract: bool = False
    stop: bool = False

    @property
    def holds(self) -> bool:
        """Whether a button that could move the needle is pressed."""
        return self.insert or self.retract

    @property
    def button(self) -> str:
        """Button of a page that is pressed; empty for none or more than one."""
        if self.insert is self.retract or self.stop:
            return ""
        return "insert" if self.insert else "retract"


class Joystick(c.Component):
    """Publishes the state of the buttons.

    Parameters
    ----------
    hand : JoystickButtons
        Buttons of the person.
    name, topic : str
        Name of the component, and its topic.
    """

    def __init__(self, hand: JoystickButtons, name: str = "joy_node", topic: str = "joy") -> None:
        self.name = name
        self.outputs = (c.Output(topic, m.Joystick, c.BEST_EFFORT),)

        def publish(at: c.Moment) -> c.Actions:
            buttons = (int(hand.insert), int(hand.retract), int(hand.stop))
            yield c.Publish(topic, m.Joystick(at.stamp_ns, (), buttons))

        self.timers = (c.Timer(1.0 / _JOY_RATE, publish),)


class OperatorModel(c.Component):
    """Acts on the published states of the rig and the visible insertion of the needle.

    Parameters
    ----------
    hand : JoystickButtons
        Its buttons.
    insertion : callable
        Returns the insertion of the needle [m].
    source : str
        Name of the node that publishes its hold.

    Attributes
    ----------
    goal : OperatorGoal
        Present goal.
    device, controller : DeviceStatus, ControllerStatus
        Last received status.
    done : bool
        Whether the controller was in state DONE once.
    absent : bool
        Whether it does nothing; the hand may still move.
    shows_lost_press : callable
        Returns whether its input device shows a lost press.
    extra_actions : list of Action
        Actions to send in the next period.
    """

    name = "person"

    def __init__(self, hand: JoystickButtons, insertion: Callable[[], float], source: str) -> None:
        self._hand = hand
        self._insertion = insertion
        self._source = source
        self.goal = OperatorGoal.INSERT
        self.device, self.controller = DeviceStatus(), ControllerStatus()
        self.done = False
        self.absent = False
        self.shows_lost_press: Callable[[float], bool] = lambda _: False
        self.extra_actions: list[c.Action] = []
        self._called: dict[str, float] = {}
        self._changed_at = 0.0
        self.inputs = (
            c.Input("device/status", DeviceStatus, self._on_device_status, c.LATCHED),
            c.Input(
                "needle/controller_status", ControllerStatus, self._on_controller_status, c.LATCHED
            ),
        )
        self.outputs = (c.Output("device/estop", m.EmergencyStop),)
        self.timers = (c.Timer(_PERIOD, self._act),)

    def _on_device_status(self, message: DeviceStatus, at: c.Moment) -> c.Actions:
        self.device = message
        return ()

    def _on_controller_status(self, message: ControllerStatus, at: c.Moment) -> c.Actions:
        self.controller = message
        self.done = self.done or message.state == "DONE"
        return ()

    def _act(self, at: c.Moment) -> c.Actions:
        yield from self.extra_actions
        self.extra_actions = []
        if self.absent:
            return
        state = self.device.state
        insert, retract = False, False
        if state in ("FAULT", "ESTOPPED"):
            if state == "ESTOPPED":
                yield c.Publish("device/estop", m.EmergencyStop(False))
            yield from self._try("device/reset", at)
        elif state == "DISABLED":
            yield from self._prepare(at)
        elif state in ("HOLDING", "MOVING"):
            insert, retract, call = self._next_action(state)
            if call is not None:
                yield from self._try(call[0], at, call[1])
        self._press(at.steady, insert=insert, retract=retract)

    def _prepare(self, at: c.Moment) -> c.Actions:
        is_out = self._insertion() < OUT
        if self.device.homed or not is_out:
            if self.goal is not OperatorGoal.LEAVE:
                yield from self._try("device/enable", at, True)
        elif not self.device.needle_out_confirmed:
            yield from self._try("device/confirm_needle_out", at, True)
        else:
            yield from self._try("device/home", at)

    def _next_action(self, state: str) -> tuple[bool, bool, tuple[str, bool | None] | None]:
        """Return whether to press insert, whether to press retract, and the service to call."""
        if self.device.activity == "homing":
            return False, False, None
        is_out = self._insertion() < OUT
        steering = self.controller.state
        if self.goal is OperatorGoal.INSERT and self.device.homed:
            if self.controller.is_steering:
                return True, False, None
            if is_out and steering in ("IDLE", "DONE", "FAULT") and not self.done:
                return False, False, ("plane_controller/start", None)
        if not is_out and self.goal is not OperatorGoal.LEAVE:
            return False, True, None
        if is_out and (self.done or self.goal is OperatorGoal.WITHDRAW):
            self.goal = OperatorGoal.LEAVE
        # Homing needs disabled axes.
        off = state == "HOLDING" and is_out and not self.device.homed
        return False, False, ("device/enable", False) if off else None

    def _press(self, now: float, *, insert: bool, retract: bool) -> None:
        """Release other buttons and stale presses; press the given button from neutral."""
        hand = self._hand
        lost = self.device.press_again == self._source or self.shows_lost_press(now)
        stale = hand.holds and (insert, retract) != (hand.insert, hand.retract)
        if hand.holds and (stale or lost):
            self._release(now)
            return
        duration = now - self._changed_at
        if hand.holds:
            # Release a press without effect after a while, and try again.
            if duration > _RETRY_AFTER and self.device.hold_owner != self._source:
                self._release(now)
        elif (insert or retract) and duration > _PAUSE:
            hand.insert, hand.retract = insert, retract
            self._changed_at = now

    def _release(self, now: float) -> None:
        self._hand.insert = self._hand.retract = False
        self._changed_at = now

    def _try(self, name: str, at: c.Moment, on: bool | None = None) -> c.Actions:
        if at.steady - self._called.get(name, -_CALL_AGAIN) >= _CALL_AGAIN:
            self._called[name] = at.steady
            yield c.Call(name, on)
