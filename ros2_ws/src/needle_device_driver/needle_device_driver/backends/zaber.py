"""Zaber controllers with firmware 7.25 or later: the ASCII protocol on a serial line or TCP."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import Any

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.axes.axis_settings import PRESENT_POSITION_METHODS, AxisSettings
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.link import DriveError
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.polled_drives import polled_backend
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure

# First version with a speed in each move, and with a command that switches the driver off.
_FIRMWARE = (7, 25)
# The drive's units of speed [counts/s] and acceleration [counts/s^2].
_SPEED_UNIT = 1.0 / 1.6384
_ACCELERATION_UNIT = 1e4 / 1.6384
# Wide limits for an axis that is not homed: its position has no meaning yet [counts].
_WIDE = 1_000_000_000

# Smallest ratio of a move's speed to that of the previous move: the drive's ramp delays the motion,
# and the slow last set-points must make up for it.
_MIN_SPEED_RATIO = 0.8

# Number of message ids each for positions, other states and procedures; orders have id 0.
_CYCLIC_IDS = 33
# These states change slowly, and a serial line is too slow for all of them: each request includes
# the next one. The home switch is read most often, because homing depends on it.
_HOME, _AWAY, _WARNINGS = "get limit.home.state", "get limit.away.state", "warnings"
_SLOW = (_HOME, _AWAY, _HOME, _WARNINGS)

_REPLY = re.compile(r"@(\d\d) (\d) (\d\d) (OK|RJ) (BUSY|IDLE) (\S\S) ([^:]*)(?::([0-9A-F]{2}))?")
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_DISABLED = "FO"
_NO_REFERENCE = "WR"
_KNOB = "NC"
# Faults that switch the driver off.
_OFF_FAULTS = {
    "FF": "has a critical system error",
    "FN": "does not support its peripheral",
    "FZ": "has an inactive peripheral",
    "FH": "has its hardware emergency stop pressed",
    "FV": "measured a supply voltage out of range",
    "FC": "measured a current inrush error",
    "FM": "has a hot motor",
    "FD": "is too hot",
    "FR": "exceeded its overdrive limit",
}
_FAULTS = {
    **_OFF_FAULTS,
    "FS": "stalled and stopped",
    "FE": "cannot reach a limit sensor",
    "FQ": "has an encoder error",
    "FI": "has an encoder index error",
}


@dataclasses.dataclass(frozen=True)
class ZaberSettings:
    """Parameters of the Zaber controllers."""

    zaber_address: str = fixed_parameter(
        "/dev/ttyUSB0", "-", "Serial device of the first controller, or HOST:55550."
    )
    zaber_insertion_device: str = fixed_parameter(
        "1", "-", "Device address of the insertion drive, and its axis if it has several: '1 2'."
    )
    zaber_rotation_device: str = fixed_parameter(
        "2", "-", "Device address of the rotation drive, and its axis if it has several."
    )


@dataclasses.dataclass
class _Axis:
    """Newest state of an axis.

    Attributes
    ----------
    target : tuple of int
        Device address and axis number.
    position_command : str
        Request for the position: measured if the device has an encoder, else counted.
    offset : int
        Count to which moves refer, minus the count of the encoder [counts].
    switches : dict of str to bool
        Request for each limit switch of the device, and whether the switch is active.
    speed : int
        Speed of the last move [counts/s].
    """

    target: tuple[int, int]
    position_command: str = "get pos"
    offset: int = 0
    speed: int = 0
    position: int = 0
    moving: bool = False
    flag: str = _DISABLED
    warnings: str = ""
    switches: dict[str, bool] = dataclasses.field(default_factory=dict)
    refusal: str = ""


@dataclasses.dataclass
class _Request:
    """A request for the states of all axes, with the replies still missing."""

    number: int
    missing: dict[tuple[str, int], str] = dataclasses.field(default_factory=dict)


class ZaberProtocol(DriveProtocol):
    """ASCII protocol with message ids and checksums.

    A set-point is sent as a point move at the set-point's speed; the drive ends it by itself.
    """

    capabilities = Capabilities(
        watchdog=math.inf,
        longest_order=0.06,
        response_time=0.04,
        encoder=False,
        switches=True,
        limits=True,
        identity=True,
        exclusive=False,
    )

    def __init__(self, parameters: Any, axes: Mapping[str, AxisSettings], link: TextLink) -> None:
        super().__init__(parameters, axes, link)
        self._axes = {
            name: _axis(f"zaber_{name}_device", getattr(parameters, f"zaber_{name}_device"))
            for name in axes
        }
        self._names = {at.target: name for name, at in self._axes.items()}
        if len(self._names) < len(axes):
            raise UserError("zaber_insertion_device and zaber_rotation_device are the same axis")
        self._requests: dict[int, _Request] = {}
        self._ask_id = 0
        self._has_checksums = False

    # ---- procedures ---------------------------------------------------------------------------

    def identify(self) -> Procedure[str]:
        """Return the devices and their firmware; end a partial line, and switch checksums on."""
        self._has_checksums = False
        self._requests.clear()
        self.link.send(b"\n")
        texts, serials = [], set()
        for device in sorted({device for device, _ in self._names}):
            version = yield from self._ask((device, 0), "get version")
            if tuple(int(part) for part in re.findall(r"\d+", version)[:2]) < _FIRMWARE:
                raise DriveError(
                    f"device {device} has firmware {version}, and {_FIRMWARE[0]}.{_FIRMWARE[1]} is "
                    f"the oldest that this driver supports"
                )
            yield from self._ask((device, 0), "set comm.checksum 1")
            serials.add((yield from self._ask((device, 0), "get system.serial")))
            kind = yield from self._ask((device, 0), "get device.id")
            texts.append(f"device {device}: ID {kind}, firmware {version}")
        self._has_checksums = True
        # No real device has the serial number 0.
        name = "Emulated Zaber" if serials == {"0"} else "Zaber"
        return f"{name}, {', '.join(texts)}"

    def set_up(self, axis: str) -> Procedure[None]:
        """Switch off; set ramps and speed; set the position; detect switches and encoder."""
        at, settings = self._axes[axis], self.axes[axis]
        ramp = settings.magnitude(settings.quick_stop_deceleration, _ACCELERATION_UNIT)
        speed = _speed(settings.magnitude(settings.speed))
        yield from self._ask(at.target, "driver disable")
        # The set-points include the ramps of a move; the drive's ramp serves only as quick stop.
        yield from self._ask(at.target, f"set accel {ramp}")
        yield from self._ask(at.target, f"set maxspeed {speed}")
        yield from self.write_limits(axis, -_WIDE, _WIDE)
        yield from self._ask(at.target, "set knob.enable 0", is_optional=True)
        yield from self._ask(at.target, "warnings clear")
        if _NO_REFERENCE in (yield from self._ask(at.target, _WARNINGS)):
            # Without a reference, a device allows motion in one direction only.
            yield from self._ask(at.target, "set pos 0")
        at.switches = {}
        # A rotation that is homed without a switch has no limit switches: save the requests.
        has_ends = settings.unit == "m" or settings.homing_method not in PRESENT_POSITION_METHODS
        for switch in (_HOME, _AWAY) if has_ends else ():
            active = yield from self._ask(at.target, switch, is_optional=True)
            if active in ("0", "1"):
                at.switches[switch] = active == "1"
        at.position_command, at.offset = "get pos", 0
        measured = yield from self._ask(at.target, "get encoder.pos", is_optional=True)
        if _NUMBER.fullmatch(measured):
            counted = yield from self._ask(at.target, "get pos")
            at.position_command = "get encoder.pos"
            at.offset = round(float(counted)) - round(float(measured))
        at.warnings = at.refusal = ""

    def clear_fault(self, axis: str) -> Procedure[None]:
        """Acknowledge the warnings."""
        at = self._axes[axis]
        yield from self._ask(at.target, "warnings clear")
        at.warnings = at.refusal = ""

    def write_limits(self, axis: str, lower: int, upper: int) -> Procedure[None]:
        """Set the software limits [counts]."""
        for name, value in (("min", lower), ("max", upper)):
            yield from self._ask(self._axes[axis].target, f"set limit.{name} {value}")

    def release(self, axis: str) -> Procedure[None]:
        """Switch the driver off."""
        yield from self._ask(self._axes[axis].target, "driver disable")

    # ---- orders -------------------------------------------------------------------------------

    def power(self, axis: str, on: bool) -> None:
        """Switch the driver on or off."""
        self._order(axis, "driver enable" if on else "driver disable")

    def move_to(self, axis: str, position: int, speed: int) -> None:
        """Send a point move with its own speed."""
        at = self._axes[axis]
        at.speed = max(speed, round(_MIN_SPEED_RATIO * at.speed))
        self._order(axis, f"move abs {position} {_speed(at.speed)}")

    def stop(self, axis: str) -> None:
        """Stop along the ramp."""
        self._axes[axis].speed = 0
        self._order(axis, "stop")

    def request(self, number: int) -> None:
        """Request all positions and some other states, each with its own message id."""
        key = 1 + number % _CYCLIC_IDS
        self._requests[key] = request = _Request(number)
        for name, at in self._axes.items():
            texts = {key: at.position_command, key + _CYCLIC_IDS: _SLOW[number % len(_SLOW)]}
            for message_id, text in texts.items():
                if message_id == key or text in (*at.switches, _WARNINGS):
                    request.missing[name, message_id] = text
                    self.link.send(_message(at.target, message_id, text))

    # ---- replies ------------------------------------------------------------------------------

    def on_line(self, line: str) -> None:
        """Handle a reply; ignore alerts, infos and lines with a wrong checksum."""
        match = _REPLY.fullmatch(line.strip())
        if match is None or not self._is_intact(match):
            return
        target, message_id = (int(match[1]), int(match[2])), int(match[3])
        accepted = match[4] == "OK"
        name = self._names.get(target, "")
        if message_id > 2 * _CYCLIC_IDS:
            self.answer((target, message_id), f"{match[4]} {match[7]}")
        elif name and message_id == 0 and not accepted:
            self._axes[name].refusal = f"refused an order: {match[7]}"
        elif name and accepted:
            self._receive_state(name, message_id, match)

    def _receive_state(self, name: str, message_id: int, match: re.Match[str]) -> None:
        at, data = self._axes[name], match[7]
        key = (message_id - 1) % _CYCLIC_IDS + 1
        request = self._requests.get(key)
        command = request.missing.get((name, message_id)) if request else None
        if request is None or command is None:
            return
        if command == _WARNINGS:
            at.warnings = data
        elif command in at.switches:
            at.switches[command] = data == "1"
        elif _NUMBER.fullmatch(data):
            at.moving, at.flag = match[5] == "BUSY", match[6]
            at.position = round(float(data)) + at.offset
        else:
            return
        del request.missing[name, message_id]
        if not request.missing:
            self.on_status(request.number, {name: _state(at) for name, at in self._axes.items()})

    def _is_intact(self, match: re.Match[str]) -> bool:
        if match[8] is None:
            return not self._has_checksums
        return _checksum(match[0][1 : match.start(8) - 1]) == match[8]

    # ---- commands -----------------------------------------------------------------------------

    def _order(self, axis: str, text: str) -> None:
        self.link.send(_message(self._axes[axis].target, 0, text))

    def _ask(
        self, target: tuple[int, int], text: str, *, is_optional: bool = False
    ) -> Procedure[str]:
        """Send a command; return its data, or an empty string for a refused optional one."""
        self._ask_id = self._ask_id % _CYCLIC_IDS + 1
        message_id = 2 * _CYCLIC_IDS + self._ask_id
        message = _message(target, message_id, text)
        flag, _, data = (yield from self.ask((target, message_id), message)).partition(" ")
        if flag == "OK":
            return data
        if not is_optional:
            raise DriveError(f"device {target[0]} refuses {text!r}: {data}")
        return ""


def _axis(parameter: str, text: str) -> _Axis:
    match = re.fullmatch(r"(\d\d?)(?: (\d))?", text)
    if match is None or int(match[1]) == 0 or match[2] == "0":
        raise UserError(f"{parameter} {text!r} must be a device 1..99, or device and axis: '1 2'")
    return _Axis((int(match[1]), int(match[2] or 1)))


def _message(target: tuple[int, int], message_id: int, text: str) -> bytes:
    body = f"{target[0]} {target[1]} {message_id} {text}"
    return f"/{body}:{_checksum(body)}\n".encode()


def _checksum(text: str) -> str:
    return f"{-sum(text.encode()) & 0xFF:02X}"


def _speed(counts_per_second: int) -> int:
    # Rounded up: a slower move would fall behind its set-points.
    return math.ceil(counts_per_second / _SPEED_UNIT)


def _state(at: _Axis) -> DriveReply:
    fault = at.refusal
    if at.flag.startswith("F") and at.flag != _DISABLED:
        fault = f"{_FAULTS.get(at.flag, 'reports a fault')} ({at.flag})"
    elif at.moving and at.flag == _KNOB:
        fault = f"is moved by its knob ({_KNOB})"
    return DriveReply(
        position=at.position,
        moving=at.moving,
        powered=at.flag != _DISABLED and at.flag not in _OFF_FAULTS,
        home_switch=at.switches.get(_HOME, False),
        inner_switch=at.switches.get(_AWAY, False),
        fault=fault,
        rebooted=_NO_REFERENCE in (at.flag, *at.warnings.split()),
    )


BACKEND = polled_backend(
    "zaber", ZaberSettings, ZaberProtocol, address=lambda parameters: parameters.zaber_address
)
