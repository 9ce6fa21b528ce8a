"""Galil DMC controller: its commands, position tracking, and one thread of a program."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from needle_sim.bus.stream_server import ClientBytes
from needle_sim.drives.motor import MotorSettings
from needle_sim.drives.text_drives import TextDrive, TextDrives

_UNKNOWN, _RUNNING = "1 Unrecognized command", "7 Command not valid while running"
_BUSY = {"DL": "17 ED, BN and DL not valid while program running"}
_BUSY |= {"XQ": "19 Application strand already executing"}
_LONGEST_LINE = 80
_REGISTERS = {"AC": 256000, "DC": 256000, "SD": 256000, "SP": 25000, "PA": 0, "PT": 0}
_REGISTERS |= {"ER": 16384, "OE": 0, "FL": 2**31 - 1, "BL": -(2**31)}
_CHANNELS = {"insertion": "A", "rotation": "B"}
_RESOLUTION = {"AC": 1024, "DC": 1024, "SD": 1024, "SP": 2}
# Commands to axes, and operands, as attributes of `GalilAxis`.
_AXIS_COMMANDS = {"SH": "servo_here", "MO": "motor_off", "BG": "begin", "ST": "stop"}
_OPERANDS = {"TP": "position", "RP": "reference", "TS": "status", "SC": "cause", "BG": "moving"}


class _RefusedError(Exception):
    """A command is refused; the argument is the reply to TC1."""


class GalilAxis(TextDrive):
    """One axis of the controller."""

    def power_up(self) -> None:
        """Set the registers as at power-up."""
        super().power_up()
        self.registers = dict(_REGISTERS)
        self.end(0)

    def end(self, code: int) -> None:
        """Switch off with a stop code."""
        self.switch_off()
        self.cause, self.moving = code, False
        # Deceleration of a stop [counts/s^2]; 0: the axis follows its target.
        self._ramp = 0

    def fail(self, code: int) -> None:
        """Switch off with an amplifier fault."""
        super().fail(code)
        self.end(15)

    def servo_here(self) -> None:
        """Switch on at the present position."""
        self.demand.hold(self.motor.position)
        self.powered, self.fault, self.moving = True, 0, False

    def motor_off(self) -> None:
        """Switch off an axis at rest."""
        if self.moving:
            raise _RefusedError(_RUNNING)
        self.switch_off()

    def begin(self) -> None:
        """Start a move to the target."""
        if not self.powered:
            raise _RefusedError("20 Begin not valid with motor off")
        self.moving, self._ramp, self.cause = True, 0, 0

    def stop(self, code: int = 4, ramp: str = "DC") -> None:
        """Brake, and leave position tracking."""
        self.registers["PT"] = 0
        if self.moving:
            self._ramp, self.cause = self.registers[ramp], code

    def write(self, name: str, value: int) -> None:
        """Write a register."""
        resolution = _RESOLUTION.get(name, 1)
        if name not in _REGISTERS:
            raise _RefusedError(_UNKNOWN)
        if not -(2**31) <= value < 2**31 or (resolution > 1 and value < resolution):
            raise _RefusedError("6 Number out of range")
        if self.moving and (name == "PT" or (name in ("PA", "DC") and not self.registers["PT"])):
            raise _RefusedError(_RUNNING)
        if name == "PA" and self.registers["PT"]:
            self.begin()
        self.registers[name] = value // resolution * resolution

    @property
    def reference(self) -> int:
        """Demanded position [counts]."""
        return round(self.demand.position - self.zero)

    @property
    def status(self) -> int:
        """Status byte of TS."""
        error = abs(self.reference - self.position) > self.registers["ER"] >= 0
        bits = self.moving << 7 | error << 6 | (not self.powered) << 5
        forward, reverse = self.motor.at_positive_switch, self.motor.at_negative_switch
        return bits | (not forward) << 3 | (not reverse) << 2

    def advance(self, period: float) -> None:
        """Advance demand and motor; switch off after a position error."""
        super().advance(period)
        if self.status & 0x40 and self.registers["OE"]:
            self.end(8)

    def advance_demand(self, period: float) -> None:
        """Follow the target, or brake at a limit or after a stop."""
        if not self.moving:
            return
        at, target = self.registers, self.registers["PA"] + self.zero
        direction = self.demand.velocity or target - self.demand.position
        forward = self.motor.at_positive_switch or self.reference > at["FL"]
        reverse = self.motor.at_negative_switch or self.reference < at["BL"]
        if not self._ramp and (forward if direction > 0.0 else reverse and direction < 0.0):
            self.stop(2 if direction > 0.0 else 3, "SD")
        if self._ramp:
            self.demand.brake(self._ramp, period)
            self.moving = not self.demand.at_rest
        elif self.demand.approach(target, at["SP"], at["AC"], at["DC"], period) and not at["PT"]:
            self.moving, self.cause = False, 1


class GalilDrives(TextDrives[GalilAxis]):
    """The controller: channel A moves the insertion, channel B the rotation axis.

    Parameters
    ----------
    motors : mapping of str to MotorSettings
        Mechanics of each axis.
    now : float
        Steady time of power-up [s].
    """

    port = "galil"
    intruder = "PTA=1;SPA=10000;PAA=1000000"
    terminators = b"\r"

    def __init__(self, motors: Mapping[str, MotorSettings], now: float) -> None:
        super().__init__(motors, now, GalilAxis)
        self._by_channel = {_CHANNELS[name]: drive for name, drive in self.drives.items()}

    def receive(self, batch: Sequence[bytes], now: float) -> list[bytes]:
        """Handle bytes from the clients; a backslash ends a download without a line end."""
        chunks = [(chunk.replace(b"\\", b"\\\r"), getattr(chunk, "client", 0)) for chunk in batch]
        return super().receive([ClientBytes(*chunk) for chunk in chunks], now)

    def reboot(self, axis: str, now: float) -> None:
        """Interrupt the controller's power: it has no program in its permanent memory."""
        super().reboot(axis, now)
        self._variables: dict[str, float] = {}
        self._program: list[str] = []
        self._download: list[str] | None = None
        # Next line of the thread; -1: it does not run. It waits until `_wake` [s].
        self._next, self._wake, self._error = -1, now, "0"
        self._powered_at = now

    def handle_line(self, line: str, now: float) -> bytes:
        """Execute a line of commands; return one reply per command."""
        if self._download is not None:
            self._download.append(line.removesuffix("\\"))
            if not line.endswith("\\"):
                return b""
            self._program, self._download = self._download, None
            return b"::"
        if len(line) > _LONGEST_LINE:
            self._error = "5 Input buffer full"
            return b"?"
        return b"".join(self._reply_to(command.strip(), now) for command in line.split(";"))

    def watch(self, now: float) -> None:
        """Execute the next commands of the program's thread."""
        # It executes about five commands per millisecond.
        for _ in range(5):
            if not 0 <= self._next < len(self._program) or now < self._wake:
                return
            command = self._program[self._next]
            self._next += 1
            match re.split(r"[ ,]+", command):
                case ["WT", samples]:
                    self._wake = now + int(samples) / 1000.0
                case ["JP", label, *condition]:
                    values = [self._value(text, now) for text in "".join(condition).split(">")]
                    if len(values) < 2 or values[0] > values[1]:
                        self._next = self._program.index(label)
                # A refused command, such as EN, ends the program.
                case _ if not command.startswith("#") and self._reply_to(command, now) == b"?":
                    self._next = -1

    def _reply_to(self, command: str, now: float) -> bytes:
        try:
            data = self._execute(command, now)
        except _RefusedError as refusal:
            (self._error,) = refusal.args
            return b"?"
        return b"" if self._download is not None else f"{data}:".encode()

    def _execute(self, command: str, now: float) -> str:
        """Execute a command; return its data."""
        name, rest = command[:2], command[2:].strip()
        if match := re.fullmatch(r"([A-Z]{2})([A-H])=(-?\d+)", command):
            self._axis(match[2]).write(match[1], int(match[3]))
        elif match := re.fullmatch(r"([a-z]\w{0,7})=(.+)", command):
            self._variables[match[1]] = self._value(match[2], now)
        elif name in _AXIS_COMMANDS:
            for channel in rest or self._by_channel:
                getattr(self._axis(channel), _AXIS_COMMANDS[name])()
        elif name in ("DL", "XQ", "HX"):
            self._control_program(name, rest.partition(",")[0])
        elif name == "RS":
            self.reboot("insertion", now)
        elif command and name not in ("CW", "VF", "EO"):
            return self._answer(command, rest, now) + "\r\n"
        return ""

    def _control_program(self, name: str, label: str) -> None:
        if name != "HX" and self._next >= 0:
            raise _RefusedError(_BUSY[name])
        if name == "XQ" and label not in self._program:
            raise _RefusedError("10 Empty program line or undefined label")
        self._download = [] if name == "DL" else None
        self._next = self._program.index(label) if name == "XQ" else -1

    def _answer(self, command: str, rest: str, now: float) -> str:
        if command.startswith("MG"):
            return "".join(f" {self._value(at, now):.4f}" for at in rest.split(","))
        if command == "\x12\x16":
            return "Emulated DMC4020 Rev 1.2"
        if command == "TC1":
            error, self._error = self._error, "0"
            return error
        raise _RefusedError(_UNKNOWN)

    def _axis(self, channel: str) -> GalilAxis:
        if channel not in self._by_channel:
            raise _RefusedError(_UNKNOWN)
        return self._by_channel[channel]

    def _value(self, expression: str, now: float) -> float:
        """Return the value of a sum of numbers, variables and operands."""
        terms = re.findall(r"([+-]?)([^+\-()]+)", expression)
        return sum((-1 if sign == "-" else 1) * self._term(term, now) for sign, term in terms)

    def _term(self, text: str, now: float) -> float:
        if text[1:3] in _OPERANDS:
            return float(getattr(self._axis(text[3:]), _OPERANDS[text[1:3]]))
        if text.isdigit():
            return float(text)
        known = {"_CN0": -1, "_XQ1": self._next} | self._variables
        known["TIME"] = round((now - self._powered_at) * 1000.0)
        if text not in known:
            raise _RefusedError("9 Variable error")
        return known[text]
