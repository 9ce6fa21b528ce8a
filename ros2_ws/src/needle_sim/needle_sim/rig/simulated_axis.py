"""An ideal axis: it moves at the speed it is told, and is where it says it is."""

from __future__ import annotations

from needle_device_driver.axes.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.procedure import Procedure


class SimulatedAxis(Axis):
    """Moves at the commanded speed from its own time on, which `advance` hands out.

    Parameters
    ----------
    name : str
        What errors call it.
    position : float
        Where it is at the start, from its home switch [m or rad].
    """

    def __init__(self, name: str, position: float = 0.0) -> None:
        self._name = name
        self._position = position
        self._target: float | None = None
        self._speed = 0.0
        self._velocity = 0.0
        self._powered = False
        self._homed = False
        self._homing = False
        self.fault = ""

    @property
    def position(self) -> float:
        """True position of the axis [m or rad]."""
        return self._position

    def configure(self) -> Procedure[None]:
        """Do nothing: an ideal axis needs no set-up."""
        yield from ()

    def power(self, on: bool) -> None:
        """Switch on or off; a target is forgotten."""
        self.stop()
        self._powered = on

    def home(self, speed: float) -> Procedure[None]:
        """Go to position 0 at `speed`."""
        yield from ()
        self._order("home")
        self._homed = self._position == 0.0
        self._homing = not self._homed
        self._target, self._speed = 0.0, speed

    def start_move(self, target: float, speed: float) -> None:
        """Go to `target` at `speed`."""
        self._order("move")
        self._target, self._speed = target, speed

    def stop(self) -> None:
        """Stop at once."""
        self._target = None
        self._velocity = 0.0
        self._homing = False

    def reset(self) -> Procedure[None]:
        """Clear the fault."""
        yield from ()
        self.fault = ""

    def poll(self, now: float) -> AxisSnapshot:
        """Return where the axis is; its replies are never late."""
        return AxisSnapshot(
            time=now,
            position=self._position,
            set_point=self._position,
            velocity=self._velocity,
            powered=self._powered,
            homed=self._homed,
            moving=self._homing or self._target not in (None, self._position),
            at_home_switch=self._position <= 0.0,
            fault=self.fault,
        )

    def close(self) -> Procedure[None]:
        """Switch off."""
        yield from ()
        self.power(False)

    def advance(self, period: float) -> None:
        """Let `period` [s] of the axis' time go by."""
        if self._target is None or not self._powered or self.fault:
            self._velocity = 0.0
            return
        before = self._position
        way = self._target - before
        reach = self._speed * period
        # Rounding of speed times period must not leave a remainder for one more period.
        if abs(way) <= reach * (1.0 + 1e-9):
            self._position = self._target
        else:
            self._position += reach if way > 0.0 else -reach
        self._velocity = (self._position - before) / period
        if self._homing and self._position == 0.0:
            self._homing = False
            self._homed = True

    def _order(self, order: str) -> None:
        if not self._powered or self.fault:
            why = self.fault or "not powered"
            raise AxisError(f"{self._name} axis cannot {order}: {why}")
