"""A joystick on a topic of sensor_msgs/Joy, which must be published continuously."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from needle_bringup.operator.controls import Controls, InputLost, InputReading, InputState

# Without a message for this time the joystick is lost [s].
JOY_TIMEOUT = 0.1


class JoySource:
    """Reads the controls from the last message, while it is recent.

    Parameters
    ----------
    controls : Controls
        Meaning of its buttons and axes.
    speed : callable
        Returns the speed at full axis, or without an axis, 0..1.
    publishers : callable
        Returns the number of publishers of the topic; with several, none is used.
    """

    def __init__(
        self, controls: Controls, speed: Callable[[], float], publishers: Callable[[], int]
    ) -> None:
        self._controls = controls
        self._speed = speed
        self._publishers = publishers
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
            As in sensor_msgs/Joy.
        now : float
            Steady time of arrival [s].
        stamp : float
            Time of sending by the sender's clock [s]; 0: unknown.
        """
        overtaken = 0.0 < stamp < self._stamp
        if overtaken and now - self._arrival <= JOY_TIMEOUT:
            return
        self._axes, self._buttons, self._arrival, self._stamp = axes, buttons, now, stamp

    def read(self, now: float) -> InputReading:
        """Return the state of the controls at this steady time [s]."""
        reason = self._timeout_reason(now)
        if reason:
            return InputLost(reason)
        controls, speed = self._controls, self._speed()
        last = max(controls.buttons)
        if last >= len(self._buttons):
            return InputLost(
                f"the joystick's message has {len(self._buttons)} buttons, but no {last}"
            )
        if controls.speed_axis is not None:
            if controls.speed_axis >= len(self._axes):
                has = f"{len(self._axes)} axes, but no {controls.speed_axis}"
                return InputLost(f"the joystick's message has {has}")
            axis = self._axes[controls.speed_axis]
            if not math.isfinite(axis):
                return InputLost(f"the joystick's axis {controls.speed_axis} is {axis}")
            speed *= controls.speed(axis)
        return InputState(
            insert=self._is_down(controls.insert),
            retract=self._is_down(controls.retract),
            stop=self._is_down(controls.stop),
            speed=speed,
        )

    def _timeout_reason(self, now: float) -> str:
        """Return why the last message is not valid; empty if it is."""
        publishers = self._publishers()
        if publishers > 1:
            return f"{publishers} nodes publish the joystick's topic, expected 1"
        if math.isinf(self._arrival):
            return "no message on the joystick's topic yet"
        if now - self._arrival > JOY_TIMEOUT:
            return f"no message from the joystick for more than {JOY_TIMEOUT:g} s"
        return ""

    def _is_down(self, button: int | None) -> bool:
        return button is not None and self._buttons[button] != 0
