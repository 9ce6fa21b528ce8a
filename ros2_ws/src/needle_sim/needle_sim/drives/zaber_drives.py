"""Emulated Zaber controllers: the ASCII protocol of firmware 7, one device for each axis."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.text_drives import TextDrive, TextDrives

# Drive units per count/s and per count/s^2.
_PER_SPEED = 1.6384
_PER_ACCELERATION = 1.6384e-4
# Distance of the encoder from the profile that counts as a stall, in time at full speed [s].
_STALL_TIME = 0.05
# Code of a stall in the diagnostics: following error.
_STALLED = 0x8611
# Flags in the order of their priority.
_FLAGS = ("FV", "FO", "FS", "WL", "WR", "WH", "NI")
_ADDRESSES = {"insertion": 1, "rotation": 2}
# The serial number 0 identifies emulated devices.
_IDENTITY = {"device.id": 50952, "system.serial": 0, "version": 7.38}


class RejectedError(Exception):
    """A device rejects a command; the text is the protocol's reason."""


class ZaberDrive(TextDrive):
    """One device with one axis.

    Attributes
    ----------
    settings : dict of str to float
        Settings, which survive a loss of power.
    has_encoder : bool
        Whether the device measures its position; otherwise a stall remains undetected.
    flags : set of str
        Active warning flags.
    """

    def __init__(self, name: str, settings: MotorSettings) -> None:
        scale = settings.max_speed
        self.has_encoder = True
        self.settings: dict[str, float] = {
            "comm.checksum": 0,
            "maxspeed": round(scale * _PER_SPEED),
            "accel": round(10.0 * scale * _PER_ACCELERATION),
            "limit.min": 0,
            "limit.max": round(min(settings.travel, 100.0 * scale)),
            "knob.enable": 1,
        }
        super().__init__(name, settings)

    def power_up(self) -> None:
        """Start: the driver holds the motor; the unknown position counts as the upper limit."""
        super().power_up()
        self.powered, self.flags = True, {"WR"}
        self._target: float | None = None
        self._speed = self._velocity = 0.0
        self.zero = self.motor.position - self.settings["limit.max"]

    def set_position(self, position: float) -> None:
        """Set the present position: a reference, although the axis is not homed."""
        self.zero = self.demand.position - position
        self.flags = self.flags - {"WR"} | {"WH"}

    def switch_off(self) -> None:
        """Switch the driver off."""
        super().switch_off()
        self.stop()

    def fail(self, code: int) -> None:
        """Switch off: the supply voltage is out of range."""
        super().fail(code)
        self.flags.add("FV")

    @property
    def is_busy(self) -> bool:
        """Whether a motion is under way."""
        return self._target is not None or self._velocity != 0.0 or not self.demand.at_rest

    @property
    def active_flags(self) -> list[str]:
        """All active flags, highest priority first."""
        flags = self.flags | (set() if self.powered else {"FO"})
        return [flag for flag in _FLAGS if flag in flags]

    @property
    def counted(self) -> int:
        """Position of the motion profile [counts]."""
        return round(self.demand.position - self.zero)

    @property
    def values(self) -> dict[str, float]:
        """Values of all settings."""
        switches = {
            "limit.home.state": self.motor.at_negative_switch,
            "limit.away.state": self.motor.at_positive_switch,
        }
        encoder = {"encoder.pos": self.position} if self.has_encoder else {}
        return {**_IDENTITY, **self.settings, **switches, "pos": self.counted, **encoder}

    def clear(self) -> None:
        """Clear the warnings that require acknowledgement."""
        self.fault = 0
        self.flags -= {"FV", "FS", "WL"}

    def move(self, target: float | None, speed: float, velocity: float = 0.0) -> None:
        """Move to a target [counts] at a speed, or at a velocity [counts/s]."""
        if not self.powered:
            raise RejectedError("DRIVERDISABLED")
        lower, upper = self.settings["limit.min"], self.settings["limit.max"]
        if target is not None and not lower <= target <= upper:
            raise RejectedError("BADDATA")
        self.flags = self.flags - {"NI"} | ({"NI"} if self.is_busy else set())
        self._target = None if target is None else target + self.zero
        self._speed, self._velocity, self._homing = speed, velocity, False

    def order(self, words: list[str]) -> bool:
        """Execute an order; return False if `words` are none."""
        match words:
            case ["stop"] | ["estop"]:
                self.stop(at_once=words == ["estop"])
            case ["driver", "disable"]:
                self.switch_off()
            case ["driver", "enable"]:
                self.powered = "FV" not in self.flags
            case ["home"]:
                self.move(None, 0.0, -self.motor.max_speed / 4.0)
                self._homing = True
            case ["move", "vel", velocity]:
                self.move(None, 0.0, float(velocity) / _PER_SPEED)
            case ["move", "abs" | "rel" as kind, value, *speed]:
                start = self.counted if kind == "rel" else 0
                fastest = float(speed[0]) if speed else self.settings["maxspeed"]
                self.move(start + float(value), fastest / _PER_SPEED)
            case _:
                return False
        return True

    def stop(self, *, at_once: bool = False) -> None:
        """Stop along the ramp, or without one."""
        self._target, self._velocity, self._homing = None, 0.0, False
        if at_once:
            self.demand.hold(self.demand.position)

    def advance_demand(self, period: float) -> None:
        """Advance the motion; a limit sensor or a stall ends it."""
        ramp = self.settings["accel"] / _PER_ACCELERATION
        if self._target is not None:
            if self.demand.approach(self._target, self._speed, ramp, ramp, period):
                self._target = None
        elif self._velocity:
            self.demand.run(self._velocity, ramp, period)
        else:
            self.demand.brake(ramp, period)
        motor, velocity = self.motor, self.demand.velocity
        if motor.is_blocked(velocity):
            if self._homing:
                self.zero = self.demand.position = 0.0
                self.flags -= {"WR", "WH"}
            elif "WR" not in self.flags:
                self.flags.add("WL")
            self.stop(at_once=True)
        gap = abs(self.demand.position - motor.position)
        if self.has_encoder and gap > _STALL_TIME * motor.max_speed:
            self.stop(at_once=True)
            self.demand.hold(motor.position)
            self.flags.add("FS")
            self.fault = _STALLED


class ZaberDrives(TextDrives[ZaberDrive]):
    """Devices 1 (insertion) and 2 (rotation) of a daisy chain, or one of them.

    Parameters
    ----------
    motors : mapping of str to MotorSettings
        Mechanics of each axis.
    now : float
        Steady time of power-up [s].
    """

    port = "zaber"
    one_processor = False
    # Line from another computer that moves the insertion axis at 10000 counts/s.
    intruder = "/1 1 move rel 20000 16384"

    def __init__(self, motors: Mapping[str, MotorSettings], now: float) -> None:
        super().__init__(motors, now, ZaberDrive)

    def handle_line(self, line: str, now: float) -> bytes:
        """Execute a message; each addressed device replies."""
        text, colon, checksum = line.partition(":")
        if not text.startswith("/") or (colon and checksum != _lrc(text[1:])):
            return b""
        words = text[1:].split()
        numbers = list(itertools.takewhile(str.isdigit, words[:3]))
        device, axis = (int(number) for number in [*numbers, "0", "0"][:2])
        message_id = f" {int(numbers[2]):02d}" if len(numbers) > 2 else ""
        replies = ""
        for name, drive in self.drives.items():
            address = _ADDRESSES[name]
            if device in (0, address) and not drive.hung and now >= drive.boots_until:
                reply = self._reply_of(drive, axis, words[len(numbers) :], now)
                body = f"{address:02d} {axis}{message_id} {reply}"
                tail = f":{_lrc(body)}" if drive.settings["comm.checksum"] else ""
                replies += f"@{body}{tail}\r\n"
        return replies.encode()

    def _reply_of(self, drive: ZaberDrive, axis: int, words: list[str], now: float) -> str:
        try:
            if axis > 1:
                raise RejectedError("BADAXIS")
            flag, data = "OK", self._execute(drive, words, now)
        except RejectedError as reason:
            flag, data = "RJ", str(reason)
        except ValueError:
            flag, data = "RJ", "BADDATA"
        status = "BUSY" if drive.is_busy else "IDLE"
        return f"{flag} {status} {(drive.active_flags or ['--'])[0]} {data}"

    def _execute(self, drive: ZaberDrive, words: list[str], now: float) -> str:
        if drive.order(words):
            return "0"
        match words:
            case []:
                pass
            case ["warnings", *clear]:
                flags = drive.active_flags
                if clear:
                    drive.clear()
                return " ".join((f"{len(flags):02d}", *flags))
            case ["system", "reset"]:
                self.reboot(drive.name, now)
            case ["get", name] if name in drive.values:
                return f"{drive.values[name]:.10g}"
            case ["set", "pos", value]:
                drive.set_position(float(value))
            case ["set", name, value] if name in drive.settings:
                drive.settings[name] = float(value)
            case _:
                raise RejectedError("BADCOMMAND")
        return "0"


def _lrc(text: str) -> str:
    """Return the checksum: the two's complement of the sum of the bytes."""
    return format((0x100 - sum(map(ord, text)) % 0x100) % 0x100, "02X")
