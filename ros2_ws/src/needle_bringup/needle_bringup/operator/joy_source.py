"""A joystick behind a topic of sensor_msgs/Joy: it must go on talking."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from needle_bringup.operator.controls import Controls
from needle_bringup.operator.hand import Hand, Lost, Reading

# Without a message for so long there is no hand [s].
LONGEST_SILENCE = 0.1


class JoySource:
    """Tells what the hand does by the last message, while it is fresh.

    Parameters
    ----------
    controls : Controls
        What its buttons and axes mean.
    speed : callable
        Returns the speed at the axis' full end, or without an axis, 0..1.
    publishers : callable
        Returns how many publish the topic: of two hands in turn none can be followed.
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

    def take(
        self, axes: Sequence[float], buttons: Sequence[int], now: float, *, stamp: float = 0.0
    ) -> None:
        """Take a message, unless a newer one was taken that still counts.

        A release that is overtaken by the next press would make that press a fresh one again.

        Parameters
        ----------
        axes, buttons : sequence
            As in sensor_msgs/Joy.
        now : float
            When it came, by the steady clock [s].
        stamp : float
            When it was sent, by the sender's clock [s]; 0: it does not say.
        """
        overtaken = 0.0 < stamp < self._stamp
        if overtaken and now - self._arrival <= LONGEST_SILENCE:
            return
        self._axes, self._buttons, self._arrival, self._stamp = axes, buttons, now, stamp

    def read(self, now: float) -> Reading:
        """Return what the hand does at this time of the steady clock [s]."""
        silence = self._silence(now)
        if silence:
            return Lost(silence)
        controls, speed = self._controls, self._speed()
        last = max(controls.buttons)
        if last >= len(self._buttons):
            return Lost(f"the joystick's message has {len(self._buttons)} buttons, none {last}")
        if controls.speed_axis is not None:
            if controls.speed_axis >= len(self._axes):
                has = f"{len(self._axes)} axes, none {controls.speed_axis}"
                return Lost(f"the joystick's message has {has}")
            axis = self._axes[controls.speed_axis]
            if not math.isfinite(axis):
                return Lost(f"the joystick's axis {controls.speed_axis} is {axis}")
            speed *= controls.speed(axis)
        return Hand(
            insert=self._is_down(controls.insert),
            retract=self._is_down(controls.retract),
            stop=self._is_down(controls.stop),
            speed=speed,
        )

    def _silence(self, now: float) -> str:
        """Return why no message counts; empty: the last one does."""
        publishers = self._publishers()
        if publishers > 1:
            return f"{publishers} nodes publish the joystick's topic, which one counts?"
        if math.isinf(self._arrival):
            return "nothing was heard of the joystick's topic yet"
        if now - self._arrival > LONGEST_SILENCE:
            return f"no message of the joystick for more than {LONGEST_SILENCE:g} s"
        return ""

    def _is_down(self, button: int | None) -> bool:
        return button is not None and self._buttons[button] != 0
