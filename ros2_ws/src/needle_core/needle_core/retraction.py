"""Retraction of the needle while a button is held: sequence of hold and service calls."""

from __future__ import annotations

import dataclasses

STOP_STEERING = "plane_controller/stop"
RETRACT = "device/retract"
BEGINS_WITHIN = 1.0
"""Time after which a retraction that is not in progress has ended, or was not needed [s]."""


@dataclasses.dataclass(frozen=True)
class HoldOrder:
    """Hold to publish, and services to call.

    Attributes
    ----------
    press : bool
        Whether `device/hold` is pressed.
    calls : tuple of str
        Services to call.
    """

    press: bool
    calls: tuple[str, ...] = ()


class Retraction:
    """Retracts the needle while a person holds.

    An active controller sends its next step as soon as the hold counts, which would first push the
    needle farther in. Therefore the hold is not passed on before steering has ended. The device
    accepts `retract` only while a hold counts. Each service is called once per press. The hold ends
    after the retraction, because a button that is still pressed must not insert the needle again.
    """

    def __init__(self) -> None:
        self._called: dict[str, float] = {}
        self._over = False

    def update(self, held: bool, now: float, *, steering: bool, hold_counts: bool) -> HoldOrder:
        """Return the hold to publish and the services to call.

        Parameters
        ----------
        held : bool
            Whether the button to retract is held.
        now : float
            Steady time [s].
        steering : bool
            Whether a controller steers.
        hold_counts : bool
            Whether this node owns the device's hold and nothing moves.
        """
        if not held:
            self._called.clear()
            self._over = False
            return HoldOrder(False)
        if steering and RETRACT not in self._called:
            return HoldOrder(False, self._call_once(STOP_STEERING, now))
        if hold_counts and now - self._called.get(RETRACT, now) > BEGINS_WITHIN:
            self._over = True
        if self._over:
            return HoldOrder(False)
        return HoldOrder(True, self._call_once(RETRACT, now) if hold_counts else ())

    def _call_once(self, service: str, now: float) -> tuple[str, ...]:
        if service in self._called:
            return ()
        self._called[service] = now
        return (service,)
