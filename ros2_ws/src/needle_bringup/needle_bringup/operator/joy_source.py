"""Joystick on a topic of type sensor_msgs/Joy, which must be published continuously."""

from __future__ import annotations

import math
from collections.abc import Sequence

from needle_bringup.operator.hold_debouncer import InputLost, InputReading, InputState
from needle_bringup.operator.parameters import NONE, OperatorParameters

# Without a message for this time, the joystick counts as lost [s].
JOY_TIMEOUT = 0.1


class JoySource:
    """Reads the controls from the last message, while it is recent.

    Parameters
    ----------
    settings : OperatorParameters
        Assignment of its buttons and axes.
    """

    def __init__(self, settings: OperatorParameters) -> None:
        self._settings = settings
        self._axes: Sequence[float] = ()
        self._buttons: Sequence[int] = ()
        self._arrival = self._stamp = -math.inf

    def receive(
        self, axes: Sequence[float], buttons: Sequence[int], now: float, *, stamp: float = 0.0
    ) -> None:
        """Receive a message; ignore it if a newer one is still valid.

        Otherwise a release that arrives after the next press would make that press a new one.

        Parameters
        ----------
        axes, buttons : sequence
            Axes and buttons as in sensor_msgs/Joy.
        now : float
            Steady time of arrival [s].
        stamp : float
            Time of sending on the sender's clock [s]; 0 if unknown.
        """
        overtaken = 0.0 < stamp < self._stamp
        if overtaken and now - self._arrival <= JOY_TIMEOUT:
            return
        self._axes, self._buttons, self._arrival, self._stamp = axes, buttons, now, stamp

    def read(self, now: float, speed: float, publishers: int) -> InputReading:
        """Return the state of the controls.

        Parameters
        ----------
        now : float
            Steady time [s].
        speed : float
            Speed at full deflection of the axis, or without an axis, 0..1.
        publishers : int
            Number of publishers of the topic; with several, none is used.
        """
        reason = self._loss_reason(now, publishers)
        if reason:
            return InputLost(reason)
        settings = self._settings
        if settings.speed_axis != NONE:
            speed *= settings.speed(self._axes[settings.speed_axis])
        insert, retract, stop = (
            key != NONE and self._buttons[key] != 0
            for key in (settings.key, settings.retract_key, settings.stop_key)
        )
        return InputState(insert=insert, retract=retract, stop=stop, speed=speed)

    def _loss_reason(self, now: float, publishers: int) -> str:
        """Return the reason why the last message is invalid; empty if it is valid."""
        last, axis = max(self._settings.keys), self._settings.speed_axis
        has, axes = "the joystick's message has", len(self._axes)
        for why, wrong in (
            (f"{publishers} nodes publish the joystick's topic, expected 1", publishers > 1),
            ("no message on the joystick's topic yet", math.isinf(self._arrival)),
            (
                f"no message from the joystick for more than {JOY_TIMEOUT:g} s",
                now - self._arrival > JOY_TIMEOUT,
            ),
            (f"{has} {len(self._buttons)} buttons, but no {last}", last >= len(self._buttons)),
            (f"{has} {axes} axes, but no {axis}", axis >= axes),
        ):
            if wrong:
                return why
        at = 0.0 if axis == NONE else self._axes[axis]
        return "" if math.isfinite(at) else f"the joystick's axis {axis} is {at}"
