"""What a press to retract asks of the rig, in its order."""

from __future__ import annotations

import dataclasses

from needle_console.hold.hold_state import HoldState, Mode

STOP_STEERING = "plane_controller/stop"
RETRACT = "device/retract"


@dataclasses.dataclass(frozen=True)
class Todo:
    """What to do now.

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
    The device takes `retract` only while a hold counts; each service is called once a press.
    """

    def __init__(self) -> None:
        self._called: set[str] = set()

    def update(self, state: HoldState, *, steering: bool, hold_counts: bool) -> Todo:
        """Return what to do.

        Parameters
        ----------
        state : HoldState
            The person's hand.
        steering : bool
            Whether a controller is there and steers.
        hold_counts : bool
            Whether the device counts our hold and nothing moves.
        """
        if not state.pressed or state.mode is not Mode.RETRACT:
            self._called.clear()
            return Todo(state.pressed)
        if steering and RETRACT not in self._called:
            return Todo(False, self._once(STOP_STEERING))
        return Todo(True, self._once(RETRACT) if hold_counts else ())

    def _once(self, service: str) -> tuple[str, ...]:
        if service in self._called:
            return ()
        self._called.add(service)
        return (service,)
