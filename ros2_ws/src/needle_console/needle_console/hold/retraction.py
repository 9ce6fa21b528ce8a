"""Drawing the needle out by a held button: hold and calls in their order."""

from __future__ import annotations

import dataclasses

from needle_console.hold.hold_state import HoldState, Mode

STOP_STEERING = "plane_controller/stop"
RETRACT = "device/retract"
BEGINS_WITHIN = 1.0
"""A retraction that is not under way so long after its call has ended, or was none [s]."""


@dataclasses.dataclass(frozen=True)
class Todo:
    """Hold to publish and services to call now.

    Attributes
    ----------
    press : bool
        What `device/hold` says.
    calls : tuple of str
        Services to call.
    """

    press: bool
    calls: tuple[str, ...] = ()


class Retraction:
    """Draws the needle out while a person holds.

    A controller that steers sends its next step as soon as somebody holds: a press that is meant to
    draw the needle out would push it first. So the hold is not passed on before steering has ended.
    The device takes `retract` only while a hold counts; each service is called once a press. When
    the needle is out the hold ends with that: who goes on holding the button then holds nothing
    that could push it in again.
    """

    def __init__(self) -> None:
        self._called: dict[str, float] = {}
        self._over = False

    def update(self, state: HoldState, now: float, *, steering: bool, hold_counts: bool) -> Todo:
        """Return what to do.

        Parameters
        ----------
        state : HoldState
            The person's hand.
        now : float
            Steady time [s].
        steering : bool
            Whether a controller is there and steers.
        hold_counts : bool
            Whether the device counts our hold and nothing moves.
        """
        if not state.pressed or state.mode is not Mode.RETRACT:
            self._called.clear()
            self._over = False
            return Todo(state.pressed)
        if steering and RETRACT not in self._called:
            return Todo(False, self._once(STOP_STEERING, now))
        if hold_counts and now - self._called.get(RETRACT, now) > BEGINS_WITHIN:
            self._over = True
        if self._over:
            return Todo(False)
        return Todo(True, self._once(RETRACT, now) if hold_counts else ())

    def _once(self, service: str, now: float) -> tuple[str, ...]:
        if service in self._called:
            return ()
        self._called[service] = now
        return (service,)
