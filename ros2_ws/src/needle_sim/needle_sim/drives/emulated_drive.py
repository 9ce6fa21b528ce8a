"""Emulated CiA 402 drive with its motor: bus, power state machine and timing."""

from __future__ import annotations

from needle_core.can_frame import CanFrame
from needle_sim.bus.canopen_device import HEARTBEAT_LOST, SDO_REQUEST, CanopenDevice
from needle_sim.drives.cia402 import (
    AT_ONCE,
    CONTROLWORD,
    ERROR_CODE,
    FAULT_RESET,
    MODE,
    STATUSWORD,
    THEN_OFF,
    EmulatedDriveSettings,
    PowerCommand,
    PowerState,
    decode_command,
    drive_dictionary,
    next_state,
)
from needle_sim.drives.drive_motion import DriveMotion
from needle_sim.drives.emulated_drives import FAULT, MOTION_STEP
from needle_sim.drives.motor import Motor

FOLLOWING_ERROR = 0x8611
_MOTION_ERROR = 0x20
_ON = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION)
_VOLTAGE, _REMOTE = 1 << 4, 1 << 9
# Ramp objects.
_SLOW_DOWN, _QUICK = 0x6084, 0x6085


class EmulatedDrive(CanopenDevice):
    """Drive on the bus. Times are readings of one steady clock [s]; motion counts its own steps.

    Parameters
    ----------
    settings : EmulatedDriveSettings
        Settings of the drive.
    """

    def __init__(self, settings: EmulatedDriveSettings) -> None:
        self.settings = settings
        self.motor = Motor(settings.motor)
        objects = drive_dictionary(settings)
        super().__init__(
            settings.node_id,
            objects,
            default_receive=(CONTROLWORD << 16 | 16,),
            default_transmit=(STATUSWORD << 16 | 16,),
            boot_time=settings.boot_time,
        )
        self._motion = DriveMotion(objects, self.motor, settings.rpm or 1.0)
        objects.entry(CONTROLWORD).on_written = self._on_controlword
        objects.entry(MODE).on_written = self._motion.set_mode
        self.state = PowerState.NOT_READY
        # Power state after the present ramp.
        self._pending_state: PowerState | None = None
        self._word = 0
        self.hung = False

    # ---- the bus ------------------------------------------------------------------------------

    def power_up(self, now: float) -> None:
        """Power up; an NMT reset does the same."""
        super().power_up(now)
        self.state = PowerState.NOT_READY
        self._pending_state = None
        self._word = 0
        self._motion.power_up()

    def receive(self, frame: CanFrame, now: float) -> None:
        """Handle a frame other than SYNC."""
        if self.hung:
            return
        if frame.identifier == SDO_REQUEST + self.node_id:
            self._update_objects()
        super().receive(frame, now)

    def sync(self) -> None:
        """Handle a SYNC: send the state of the motor, then apply the set-point received before."""
        if self.hung:
            return
        self._update_objects()
        super().sync()
        if self.state is PowerState.OPERATION_ENABLED and self._pending_state is None:
            self._motion.apply_set_point()

    def tick(self, now: float) -> None:
        """Handle timers."""
        if not self.hung:
            self._update_objects()
            super().tick(now)

    def fail(self, code: int) -> None:
        """Enter a fault with this error code: brake, then FAULT."""
        if self.state in (PowerState.FAULT, PowerState.FAULT_REACTION, PowerState.NOT_READY):
            return
        self._pending_state = None
        self._objects.set(ERROR_CODE, 0, code)
        self.state = PowerState.FAULT_REACTION if self.state in _ON else PowerState.FAULT
        # The CANopen device reports a lost heartbeat itself.
        if code != HEARTBEAT_LOST:
            self.emergency(code, _MOTION_ERROR)

    @property
    def error_code(self) -> int:
        """Error code, 0x603F; 0 without a fault."""
        return self._objects.value(ERROR_CODE)

    # ---- motion -------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Advance by a number of `MOTION_STEP`."""
        for _ in range(steps):
            if self.state not in _ON or self._settled:
                self._motion.rest()
                break
            self._step(MOTION_STEP)

    @property
    def _settled(self) -> bool:
        """Whether the state stays constant without further commands."""
        if self._pending_state is not None or self.state is PowerState.FAULT_REACTION:
            return False
        return self._motion.settled and not self._ends_quick_stop

    def _step(self, period: float) -> None:
        motion = self._motion
        if self.state is PowerState.QUICK_STOP_ACTIVE:
            motion.brake(_QUICK, period)
            if self._ends_quick_stop and motion.at_rest:
                self.state = PowerState.SWITCH_ON_DISABLED
        elif self.state is PowerState.FAULT_REACTION:
            motion.brake(_QUICK, period)
            if motion.at_rest:
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
    def _ends_quick_stop(self) -> bool:
        """Whether the drive switches off after its present quick stop."""
        is_active = self.state is PowerState.QUICK_STOP_ACTIVE
        return is_active and self._objects.value(0x605A) == THEN_OFF

    # ---- power --------------------------------------------------------------------------------

    def _on_controlword(self, word: int) -> None:
        rising = word & ~self._word
        self._word = word
        if self.state is PowerState.FAULT:
            if rising & FAULT_RESET:
                self._objects.set(ERROR_CODE, 0, 0)
                self.emergency(0)
                self.state = PowerState.SWITCH_ON_DISABLED
        elif self._pending_state is None:
            self._change(next_state(self.state, word))
        if self.state is PowerState.OPERATION_ENABLED and self._pending_state is None:
            self._motion.apply_controlword(word, rising)

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
        return self._objects.value(index) != AT_ONCE

    def on_boot(self) -> None:
        """Become ready to be switched on."""
        self.state = PowerState.SWITCH_ON_DISABLED

    def on_connection_lost(self) -> None:
        """Enter a fault."""
        self.fail(HEARTBEAT_LOST)

    @property
    def state_text(self) -> str:
        """Power state, with the error code of a fault."""
        is_fault = self.state is PowerState.FAULT
        return f"{FAULT} 0x{self.error_code:04X}" if is_fault else self.state.name

    def _update_objects(self) -> None:
        """Update the objects that a master can read."""
        bits = self._motion.update_objects(enabled=self.state is PowerState.OPERATION_ENABLED)
        self._objects.set(STATUSWORD, 0, self.state.value | _VOLTAGE | _REMOTE | bits)
