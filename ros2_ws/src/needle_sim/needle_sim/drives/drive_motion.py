"""Motion of a powered drive: its modes, ramps, limits and following error."""

from __future__ import annotations

from collections.abc import Generator

from needle_sim.bus.object_dictionary import ObjectDictionary
from needle_sim.drives.cia402 import (
    CONTROLWORD,
    CYCLIC_SYNCHRONOUS_POSITION,
    HOMING,
    POSITION,
    PROFILE_POSITION,
    TARGET_POSITION,
)
from needle_sim.drives.emulated_drives import MOTION_STEP
from needle_sim.drives.motion_profile import METHODS, Demand, home
from needle_sim.drives.motor import Motor

# Mode-specific bits of the controlword and of the statusword.
NEW_SET_POINT = HOMING_START = 1 << 4
_AT_ONCE, _RELATIVE = 1 << 5, 1 << 6
HALT = 1 << 8
_REACHED, _LIMITED, _BIT_12, _BIT_13 = 1 << 10, 1 << 11, 1 << 12, 1 << 13
# Bits of the digital inputs (0x60FD).
_NEGATIVE_SWITCH, _POSITIVE_SWITCH, _HOME_SWITCH = 1, 2, 4
_NO_WINDOW = 0xFFFFFFFF
_MODE_DISPLAY = 0x6061


class DriveMotion:
    """Motion of a powered drive: modes, ramps, limits and following error.

    Positions are true counts of the motor.

    Parameters
    ----------
    objects : ObjectDictionary
        Objects of the drive.
    motor : Motor
        Motor to move.
    speed_unit : float
        Unit of the drive's speeds [counts/s] and ramps [counts/s^2].
    """

    def __init__(self, objects: ObjectDictionary, motor: Motor, speed_unit: float) -> None:
        self._speed_unit = speed_unit
        self._objects = objects
        self._motor = motor
        self._demand = Demand(motor.position)
        self._zero = motor.position
        self._homed = False
        self._homing: Generator[None, None, float] | None = None
        self._homing_failed = False
        self._target: float | None = None
        self._next_target: float | None = None
        self._limited = False
        self._late = 0.0

    # ---- power --------------------------------------------------------------------------------

    def power_up(self) -> None:
        """Power up: un-homed, and counting from the present position."""
        self.switch_off()
        self._zero = self._motor.position
        self._homed = self._homing_failed = self._limited = False

    def switch_off(self) -> None:
        """Switch the motor off; the friction of screw and gear holds it."""
        self._motor.rest()
        self._demand.hold(self._motor.position)
        self.clear_targets()

    def clear_targets(self) -> None:
        """Discard all targets; a motion under way still needs a ramp."""
        self._target = self._next_target = self._homing = None
        self._late = 0.0

    # ---- commands -----------------------------------------------------------------------------

    def set_mode(self, mode: int) -> None:
        """Set the mode of operation."""
        if mode != self._mode:
            self.clear_targets()
            self._objects.set(_MODE_DISPLAY, 0, mode)

    def apply_controlword(self, word: int, rising: int) -> None:
        """Apply the mode-specific bits of a controlword, and those of them that are new."""
        if self._mode == PROFILE_POSITION and rising & NEW_SET_POINT:
            self._start_profile_motion(word)
        elif self._mode == HOMING and rising & HOMING_START:
            self._start_homing()
        elif self._mode == HOMING and not word & HOMING_START:
            self._homing = None

    def apply_set_point(self) -> None:
        """Apply the target of cyclic synchronous position mode; the motion ends there."""
        if self._mode != CYCLIC_SYNCHRONOUS_POSITION or self._halted:
            return
        target = self._within_limits(self._objects.value(TARGET_POSITION))
        distance = target + self._zero - self._demand.position
        if self._motor.is_blocked(distance):
            self._limited = True
        elif distance != 0.0:
            period = self._objects.value(0x60C2, 1) * 10.0 ** self._objects.value(0x60C2, 2)
            self._demand.begin_segment(target + self._zero, float(max(period, MOTION_STEP)))

    # ---- time ---------------------------------------------------------------------------------

    @property
    def at_rest(self) -> bool:
        """Whether the demand is at rest, regardless of the motor."""
        return self._demand.at_rest

    @property
    def settled(self) -> bool:
        """Whether the state stays constant without further commands."""
        return (
            self._demand.at_rest
            and self._motor.position == self._demand.position
            and self._homing is None
            and self._target is None
        )

    def rest(self) -> None:
        """Rest for one step."""
        self._motor.rest()
        self._late = 0.0

    def operate(self, period: float) -> None:
        """Advance the demand by `period` [s] in the present mode."""
        demand = self._demand
        if self._homing is None and self._motor.is_blocked(demand.velocity):
            self.brake(0x6085, period)
            self._target = self._next_target = None
            self._limited = True
        elif self._mode == CYCLIC_SYNCHRONOUS_POSITION and not self._halted:
            demand.interpolate(period)
        elif self._mode == PROFILE_POSITION and self._target is not None and not self._halted:
            speed = min(self._speed(0x6081), self._speed(0x607F))
            ramps = self._speed(0x6083), self._speed(0x6084)
            if demand.approach(self._target, speed, *ramps, period):
                self._target, self._next_target = self._next_target, None
        elif self._homing is not None and not self._halted:
            self._home(self._homing)
        else:
            self.brake(0x6084, period)

    def brake(self, ramp: int, period: float) -> None:
        """Decelerate the demand along the ramp in object `ramp`."""
        self._demand.brake(self._speed(ramp), period)

    def follow(self, period: float) -> bool:
        """Move the motor for `period` [s]; return whether the following error lasts too long."""
        self._motor.follow(self._demand.position, period)
        window = self._objects.value(0x6065)
        error = abs(self._demand.position - self._motor.position)
        self._late = self._late + period if error > window and window != _NO_WINDOW else 0.0
        return self._late > self._objects.value(0x6066) * 1e-3

    # ---- objects for the master ---------------------------------------------------------------

    def update_objects(self, *, enabled: bool) -> int:
        """Update the objects; return the mode-specific bits of the statusword."""
        put, motor = self._objects.set, self._motor
        position = round(motor.position - self._zero)
        demanded = round(self._demand.position - self._zero)
        put(POSITION, 0, position)
        put(0x6062, 0, demanded)
        put(0x60F4, 0, demanded - position)
        put(0x606C, 0, round(motor.velocity / self._speed_unit))
        put(0x6077, 0, 1000 if motor.stalled and demanded != position else 0)
        inputs = _NEGATIVE_SWITCH | _HOME_SWITCH if motor.at_negative_switch else 0
        put(0x60FD, 0, inputs | (_POSITIVE_SWITCH if motor.at_positive_switch else 0))
        return self._status_bits(enabled=enabled)

    def _status_bits(self, *, enabled: bool) -> int:
        at_rest = self._demand.at_rest
        reached = bit_12 = bit_13 = False
        if self._mode == PROFILE_POSITION:
            reached = self._target is None and at_rest
            bit_12, bit_13 = bool(self._word & NEW_SET_POINT), self._late > 0.0
        elif self._mode == HOMING:
            reached = self._homing is None and at_rest
            bit_12, bit_13 = self._homed, self._homing_failed
        elif self._mode == CYCLIC_SYNCHRONOUS_POSITION:
            bit_12, bit_13 = enabled, self._late > 0.0
        return self._limited * _LIMITED | reached * _REACHED | bit_12 * _BIT_12 | bit_13 * _BIT_13

    # ---- details ------------------------------------------------------------------------------

    def _speed(self, index: int, subindex: int = 0) -> float:
        """Return a speed object in counts/s, or a ramp object in counts/s^2."""
        return self._objects.value(index, subindex) * self._speed_unit

    @property
    def _mode(self) -> int:
        return self._objects.value(_MODE_DISPLAY)

    @property
    def _word(self) -> int:
        return self._objects.value(CONTROLWORD)

    @property
    def _halted(self) -> bool:
        return bool(self._word & HALT)

    def _start_profile_motion(self, word: int) -> None:
        value = self._objects.value
        start = value(POSITION) if word & _RELATIVE else 0
        target = self._within_limits(start + value(TARGET_POSITION))
        if word & _AT_ONCE or self._target is None:
            self._target, self._next_target = target + self._zero, None
        else:
            self._next_target = target + self._zero

    def _start_homing(self) -> None:
        value = self._objects.value
        self._homing_failed = value(0x6098) not in METHODS
        if self._homing_failed:
            return
        self._homed = self._limited = False
        self._homing = home(
            value(0x6098),
            self._motor,
            self._demand,
            speed=self._speed(0x6099, 1),
            edge_speed=self._speed(0x6099, 2),
            ramp=self._speed(0x609A),
        )

    def _home(self, homing: Generator[None, None, float]) -> None:
        try:
            next(homing)
        except StopIteration as ended:
            self._zero = ended.value + self._objects.value(0x607C)
            self._homed = True
            self._homing = None

    def _within_limits(self, target: int) -> int:
        """Return the target, clipped to the software limits of a homed drive."""
        lower, upper = self._objects.value(0x607D, 1), self._objects.value(0x607D, 2)
        self._limited = self._homed and not lower <= target <= upper
        return min(max(target, lower), upper) if self._limited else target
