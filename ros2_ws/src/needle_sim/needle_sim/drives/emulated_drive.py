"""Emulated CiA 402 drive with its motor: bus, power state machine and timing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from needle_core.can_frame import CanFrame
from needle_sim.bus.canopen_device import HEARTBEAT_LOST, CanopenDevice
from needle_sim.bus.object_dictionary import Abort, SdoAbortError
from needle_sim.drives.cia402 import (
    CONTROLWORD,
    ERROR_CODE,
    FAULT_RESET,
    MODE,
    MODES,
    STATUSWORD,
    PowerCommand,
    PowerState,
    decode_command,
    drive_dictionary,
    next_state,
)
from needle_sim.drives.drive_motion import DriveMotion, LimitAction, LimitExceededError
from needle_sim.drives.emulated_drives import MOTION_STEP
from needle_sim.drives.motion_profile import METHODS
from needle_sim.drives.motor import Motor, MotorSettings

FOLLOWING_ERROR = 0x8611
LIMIT_EXCEEDED = 0x8612
_MOTION_ERROR = 0x20
_ON = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION)
_VOLTAGE, _REMOTE = 1 << 4, 1 << 9
# Ramp objects.
_SLOW_DOWN, _QUICK = 0x6084, 0x6085
# Option codes (0x6007, 0x605A, 0x605B, 0x605C, 0x605E).
_AT_ONCE = 0
_LOST_FAULT, _LOST_DISABLE, _LOST_QUICK_STOP = 1, 2, 3
_BY_SLOW_DOWN = (1, 5)
_THEN_DISABLE = (1, 2)


@dataclasses.dataclass(frozen=True)
class EmulatedDriveSettings:
    """Settings of an emulated drive.

    Attributes
    ----------
    name : str
        Name of the axis.
    node_id : int
        1..127.
    device_type : int
        Object 0x1000: stepper or servo.
    motor : MotorSettings
        Mechanics of the axis.
    limit_action : LimitAction
        Reaction to a target beyond the software limits.
    boot_time : float
        From power-up to the boot-up message [s].
    rpm : float or None
        One rpm of the motor [counts/s], for a drive with speeds in rpm and ramps in rpm/s.
    """

    name: str
    node_id: int
    device_type: int
    motor: MotorSettings
    limit_action: LimitAction
    boot_time: float
    rpm: float | None = None


class EmulatedDrive:
    """Drive on the bus. Times are readings of one steady clock [s]; motion counts its own steps.

    Parameters
    ----------
    settings : EmulatedDriveSettings
        Settings of the drive.
    """

    def __init__(self, settings: EmulatedDriveSettings) -> None:
        self.settings = settings
        self.motor = Motor(settings.motor)
        self._objects = objects = drive_dictionary(
            settings.name,
            settings.device_type,
            settings.node_id,
            counts_per_unit=settings.motor.counts_per_unit,
            rpm=settings.rpm,
        )
        speed_unit = settings.rpm or 1.0
        self._motion = DriveMotion(objects, self.motor, settings.limit_action, speed_unit)
        self.device = CanopenDevice(
            settings.node_id,
            objects,
            default_receive=(CONTROLWORD << 16 | 16,),
            default_transmit=(STATUSWORD << 16 | 16,),
            boot_time=settings.boot_time,
            on_power_up=self._on_power_up,
            on_boot=self._on_boot,
            on_connection_lost=self._on_connection_lost,
        )
        objects.on_write(CONTROLWORD, 0, then=self._on_controlword)
        objects.on_write(MODE, 0, check=_one_of(MODES), then=self._motion.set_mode)
        objects.on_write(0x6098, 0, check=_one_of((0, *METHODS)))
        self.state = PowerState.NOT_READY
        # Power state after the present ramp.
        self._pending_state: PowerState | None = None
        self._word = 0
        self.hung = False
        # Whether the objects need an update before the master reads them.
        self._stale = True

    # ---- the bus ------------------------------------------------------------------------------

    def power_up(self, now: float) -> None:
        """Power up."""
        self.device.power_up(now)

    def receive(self, frame: CanFrame, now: float) -> None:
        """Handle a frame other than SYNC."""
        if not self.hung:
            if self.device.is_read_request(frame):
                self._update_objects()
            self._stale |= self.device.receive(frame, now)

    def sync(self) -> None:
        """Handle a SYNC: send the state of the motor, then apply the set-point received before."""
        if self.hung:
            return
        self._update_objects()
        self.device.sync()
        if self.state is PowerState.OPERATION_ENABLED and self._pending_state is None:
            self._try(self._motion.apply_set_point)
        self._stale = True

    def tick(self, now: float) -> None:
        """Handle timers."""
        if not self.hung:
            self._update_objects()
            self.device.tick(now)

    def fail(self, code: int) -> None:
        """Enter a fault with this error code: brake, then FAULT."""
        if self.state in (PowerState.FAULT, PowerState.FAULT_REACTION, PowerState.NOT_READY):
            return
        self._pending_state = None
        self._objects.set(ERROR_CODE, 0, code)
        self.state = PowerState.FAULT_REACTION if self.state in _ON else PowerState.FAULT
        # The CANopen device reports a lost heartbeat itself.
        if code != HEARTBEAT_LOST:
            self.device.emergency(code, _MOTION_ERROR)
        self._stale = True

    @property
    def error_code(self) -> int:
        """Error code, 0x603F; 0 without a fault."""
        return self._objects.value(ERROR_CODE)

    # ---- motion -------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Advance by a number of `MOTION_STEP`."""
        for _ in range(steps):
            if self.state not in _ON or self._settled:
                self._stale |= self._motion.rest()
                break
            self._step(MOTION_STEP)
            self._stale = True

    @property
    def _settled(self) -> bool:
        """Whether the state stays constant without further commands."""
        if self._pending_state is not None or self.state is PowerState.FAULT_REACTION:
            return False
        if self.state is PowerState.QUICK_STOP_ACTIVE and self._quick_stop_option in _THEN_DISABLE:
            return False
        return self._motion.settled

    def _step(self, period: float) -> None:
        motion = self._motion
        if self.state is PowerState.QUICK_STOP_ACTIVE:
            option = self._quick_stop_option
            motion.brake(_SLOW_DOWN if option in _BY_SLOW_DOWN else _QUICK, period)
            if option == _AT_ONCE or (option in _THEN_DISABLE and motion.at_rest):
                self.state = PowerState.SWITCH_ON_DISABLED
        elif self.state is PowerState.FAULT_REACTION:
            option = self._objects.value(0x605E)
            motion.brake(_SLOW_DOWN if option == 1 else _QUICK, period)
            if option == _AT_ONCE or motion.at_rest:
                self.state = PowerState.FAULT
        elif self._pending_state is not None:
            motion.brake(_SLOW_DOWN, period)
            if motion.at_rest:
                self.state, self._pending_state = self._pending_state, None
        else:
            motion.operate(period)
        if self.state not in _ON:
            motion.switch_off()
        elif motion.follow(period):
            self.fail(FOLLOWING_ERROR)

    @property
    def _quick_stop_option(self) -> int:
        return self._objects.value(0x605A)

    # ---- power --------------------------------------------------------------------------------

    def _on_controlword(self, word: int) -> None:
        rising = word & ~self._word
        self._word = word
        if self.state is PowerState.FAULT:
            if rising & FAULT_RESET:
                self._objects.set(ERROR_CODE, 0, 0)
                self.device.emergency(0)
                self.state = PowerState.SWITCH_ON_DISABLED
        elif self._pending_state is None:
            self._change(next_state(self.state, word))
        enabled = self.state is PowerState.OPERATION_ENABLED and self._pending_state is None
        self._try(lambda: self._motion.apply_controlword(word, enabled=enabled))

    def _change(self, state: PowerState) -> None:
        before = self.state
        if state is before:
            return
        self._motion.clear_targets()
        if before is PowerState.OPERATION_ENABLED and self._brakes_before(state):
            self._pending_state = state
            return
        self.state = state
        if state not in _ON:
            self._motion.switch_off()

    def _brakes_before(self, state: PowerState) -> bool:
        """Return whether the motor brakes before its power is switched off."""
        at_once = decode_command(self._word) is PowerCommand.DISABLE_VOLTAGE or self._motion.at_rest
        if state in _ON or at_once:
            return False
        index = 0x605B if state is PowerState.READY_TO_SWITCH_ON else 0x605C
        return self._objects.value(index) != _AT_ONCE

    def _try(self, command: Callable[[], None]) -> None:
        try:
            command()
        except LimitExceededError:
            self.fail(LIMIT_EXCEEDED)

    def _on_power_up(self) -> None:
        self.state = PowerState.NOT_READY
        self._pending_state = None
        self._word = 0
        self._motion.power_up()
        self._stale = True

    def _on_boot(self) -> None:
        self.state = PowerState.SWITCH_ON_DISABLED
        self._stale = True

    def _on_connection_lost(self) -> None:
        self._stale = True
        option = self._objects.value(0x6007)
        if option == _LOST_FAULT:
            self.fail(HEARTBEAT_LOST)
        elif option == _LOST_DISABLE and self.state in _ON[:2]:
            self.state = PowerState.SWITCH_ON_DISABLED
            self._motion.switch_off()
        elif option == _LOST_QUICK_STOP and self.state is PowerState.OPERATION_ENABLED:
            self._change(PowerState.QUICK_STOP_ACTIVE)

    def _update_objects(self) -> None:
        """Update the objects that a master can read."""
        if not self._stale:
            return
        self._stale = False
        bits = self._motion.update_objects(enabled=self.state is PowerState.OPERATION_ENABLED)
        self._objects.set(STATUSWORD, 0, self.state.value | _VOLTAGE | _REMOTE | bits)


def _one_of(values: tuple[int, ...]) -> Callable[[int], None]:
    def check(value: int) -> None:
        if value not in values:
            raise SdoAbortError(Abort.VALUE_RANGE)

    return check
