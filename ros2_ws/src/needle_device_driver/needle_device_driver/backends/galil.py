"""Galil DMC controllers over TCP: position tracking, with a watchdog program on the controller."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import deque
from collections.abc import Mapping
from typing import Any

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.link import DriveError
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.polled_drives import polled_backend
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, Wait

_CHANNELS = tuple("ABCDEFGH")
# Bits of _TS; a limit switch reads 1 while it is inactive (CN -1).
_MOVING, _MOTOR_OFF, _FORWARD_INACTIVE, _REVERSE_INACTIVE = 0x80, 0x20, 0x08, 0x04
# Values of _SC: stops that end position tracking (limits, ST), and reasons why an axis is off.
_STOPS = (2, 3, 4)
_REASONS = {
    6: "was stopped by its abort input",
    8: "exceeded its following error and switched off",
    11: "was stopped by its selective abort input",
    12: "reports an encoder failure",
    15: "reports an amplifier fault",
}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
# Resolution of AC, DC and SD [counts/s^2], and of SP [counts/s]; the controller rounds down.
_RAMP_STEP, _SPEED_STEP = 1024, 2
# The watchdog program counts `nsbeat` down with this period [s].
_COUNTDOWN = 0.01
_WATCHDOG = """\
#NSDOG
nsbeat=nsbeat-1
WT 10
JP #NSDOG,nsbeat>0
ST{channels}
#NSSTOP
WT 2
JP #NSSTOP,({moving})>0
MO{channels}
#NSIDLE
WT 10
JP #NSIDLE
"""
# The program has stopped the axes once it is at this line or a later one.
_STOPPED = 5
_HINT = ": halt the controller's own program (HX) and free its program memory"


@dataclasses.dataclass(frozen=True)
class GalilSettings:
    """Address of the controller, and its channels."""

    galil_address: str = fixed_parameter("192.168.1.2:23", "-", "Galil controller, host:port.")
    galil_insertion_channel: str = fixed_parameter(
        "A", "-", "Channel of the insertion axis on the Galil controller.", choices=_CHANNELS
    )
    galil_rotation_channel: str = fixed_parameter(
        "B", "-", "Channel of the rotation axis on the Galil controller.", choices=_CHANNELS
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Expected:
    """A reply expected from the controller.

    Attributes
    ----------
    command : str
        The command.
    asked : bool
        Whether a procedure waits for it.
    axis : str
        Axis on which a refusal is reported as a fault; empty: a refusal is ignored.
    number : int
        Number of the status request; 0: not a status request.
    """

    command: str
    asked: bool = False
    axis: str = ""
    number: int = 0

    @property
    def has_data(self) -> bool:
        """Whether the reply has text before its colon."""
        return self.command.startswith(("MG", "TC", "\x12"))


class GalilProtocol(DriveProtocol):
    """All axes of one controller.

    A reply says only that a command was accepted (`:`) or refused (`?`), so replies are matched by
    their order; a status reply has a number, which restores the order if a reply was lost.
    """

    terminators = b":?"
    capabilities = Capabilities(
        watchdog=0.1,
        longest_order=2.0 * PERIOD,
        response_time=PERIOD,
        encoder=True,
        switches=True,
        limits=True,
        identity=True,
        exclusive=False,
    )

    def __init__(self, parameters: Any, axes: Mapping[str, AxisSettings], link: TextLink) -> None:
        super().__init__(parameters, axes, link)
        self._channels = {axis: getattr(parameters, f"galil_{axis}_channel") for axis in axes}
        if parameters.galil_insertion_channel == parameters.galil_rotation_channel:
            raise UserError("galil_insertion_channel and galil_rotation_channel are the same")
        self._last = list(axes)[-1]
        # The program stops the axes one or two of its periods before the watchdog time expires.
        self._beat = f"nsbeat={round(parameters.watchdog / _COUNTDOWN) - 2}"
        self._expected: deque[_Expected] = deque()
        # Target of an axis in position tracking, and the demanded position on the way there.
        self._targets: dict[str, int | None] = dict.fromkeys(axes)
        self._references = dict.fromkeys(axes, 0)
        self._refusals = dict.fromkeys(axes, "")
        # Axes whose stop code was acknowledged.
        self._cleared: set[str] = set()
        self._armed = self._stopped = self._restarted = False
        self._clock = 0

    def identify(self) -> Procedure[str]:
        """Return model and revision; set the format of numbers and of the program's messages."""
        self._expected.clear()
        # CW 1 sets bit 7 of each character in the messages of a program.
        yield from self._execute("CW 1")
        yield from self._execute("VF 10.4")
        return (yield from self._execute("\x12\x16"))

    def set_up(self, axis: str) -> Procedure[None]:
        """Switch an axis off and write its settings; the last axis starts the watchdog."""
        at, channel = self.axes[axis], self._channels[axis]
        self._refusals[axis] = ""
        self._cleared.add(axis)
        yield from self._switch_off(axis)
        ramp = -(-at.magnitude(at.quick_stop_deceleration) // _RAMP_STEP) * _RAMP_STEP
        rise = max(at.magnitude(at.acceleration) // _RAMP_STEP, 1) * _RAMP_STEP
        # Position tracking brakes before each set-point: with the steeper ramp it lags less.
        settings = {"AC": rise, "DC": ramp, "ER": at.magnitude(at.following_error), "OE": 1}
        settings |= {"FL": 2**31 - 1, "BL": -(2**31)}
        for name, value in settings.items():
            yield from self._execute(f"{name}{channel}={value}")
        # Old controllers have no SD and use DC at a limit.
        yield from self._execute(f"SD{channel}={ramp}", may_refuse=True)
        if axis == self._last:
            if (yield from self._read("_CN0")) != -1.0:
                raise DriveError(
                    "its limit switches are active high (CN 1), expected active low: wire them so "
                    "and set CN -1"
                )
            yield from self._download()
            yield from self._start_watchdog()

    def clear_fault(self, axis: str) -> Procedure[None]:
        """Clear a refusal and a stop code; restart a watchdog that has stopped the axes."""
        self._refusals[axis] = ""
        self._cleared.add(axis)
        if axis == self._last and self._stopped:
            yield from self._start_watchdog()

    def write_limits(self, axis: str, lower: int, upper: int) -> Procedure[None]:
        """Write the software limits [counts]."""
        yield from self._execute(f"FL{self._channels[axis]}={upper}")
        yield from self._execute(f"BL{self._channels[axis]}={lower}")

    def release(self, axis: str) -> Procedure[None]:
        """Switch an axis off; the last one also ends the watchdog program."""
        yield from self._switch_off(axis)
        if axis == self._last:
            self._armed = False
            yield from self._execute("HX1")

    def power(self, axis: str, on: bool) -> None:
        """Hold the present position, or switch off."""
        self._targets[axis] = None
        channel = self._channels[axis]
        if on:
            self._send(f"SH{channel}", axis=axis)
        else:
            # A controller may refuse MO while the axis moves; the order is then repeated.
            self._send(f"ST{channel}", f"MO{channel}")

    def move_to(self, axis: str, position: int, speed: int) -> None:
        """Track a position at a speed [counts/s], or faster to make up for a lag."""
        channel, at = self._channels[axis], self.axes[axis]
        if self._targets[axis] is None:
            self._send(f"PT{channel}=1", axis=axis)
        self._targets[axis] = position
        # The demanded position is about one cycle old.
        needed = abs(position - self._references[axis]) / (2.0 * PERIOD)
        speed = max(speed, min(math.ceil(needed), at.magnitude(at.speed)))
        speed += speed % _SPEED_STEP
        self._send(f"SP{channel}={speed}", f"PA{channel}={position}", axis=axis)

    def stop(self, axis: str) -> None:
        """Brake; this also ends position tracking."""
        self._targets[axis] = None
        self._send(f"ST{self._channels[axis]}")

    def beat(self) -> None:
        """Restart the watchdog's countdown."""
        self._send(self._beat)

    def request(self, number: int) -> None:
        """Request positions, switches and stop codes of all axes, the watchdog and the clock."""
        of_axes = (f"_TP{at},_RP{at},_TS{at},_SC{at}" for at in self._channels.values())
        self._send(f"MG {number},{','.join(of_axes)},_XQ1,TIME", number=number)

    def on_line(self, line: str) -> None:
        """Match a reply with its command."""
        text, refused = line[:-1], line[-1] == "?"
        values = [float(number) for number in _NUMBER.findall(text)]
        requests = [at.number for at in self._expected if at.number]
        if len(values) == 3 + 4 * len(self.axes) and values[0] in requests:
            # The replies expected before this one were lost.
            while self._expected.popleft().number != values[0]:
                pass
            self._on_state(list(map(round, values)))
        elif (expected := self._match(text, refused)) is None:
            return
        elif expected.asked:
            self.answer(expected, "?" if refused else text)
        elif expected.command == "TC1":
            self._refusals[expected.axis] = f"refuses an order (error {text})"
        elif refused and expected.axis:
            self._send("TC1", axis=expected.axis)

    def _match(self, text: str, refused: bool) -> _Expected | None:
        while self._expected and (refused or text or not self._expected[0].has_data):
            expected = self._expected.popleft()
            if refused or bool(text) == expected.has_data:
                return expected
        return None

    def _on_state(self, values: list[int]) -> None:
        number, *states, line, clock = values
        self._stopped = self._armed and line >= _STOPPED
        # A controller restart ends the program, or starts a stored one, and resets the clock.
        self._restarted |= self._armed and (line < 0 or clock < self._clock)
        self._clock = clock
        newer_orders = {at.axis for at in self._expected}
        replies = {}
        for index, (axis, settings) in enumerate(self.axes.items()):
            position, reference, switches, code = states[4 * index : 4 * index + 4]
            self._references[axis] = reference
            powered = not switches & _MOTOR_OFF
            if powered:
                self._cleared.discard(axis)
            is_moving = bool(switches & _MOVING)
            if not is_moving and code in _STOPS and axis not in newer_orders:
                self._targets[axis] = None
            outer, inner = not switches & _REVERSE_INACTIVE, not switches & _FORWARD_INACTIVE
            is_off = not powered and axis not in self._cleared
            replies[axis] = DriveReply(
                position=position,
                # In position tracking an axis may count as moving at its target.
                moving=is_moving and reference != self._targets[axis],
                powered=powered,
                home_switch=inner if settings.reverse else outer,
                inner_switch=outer if settings.reverse else inner,
                fault=(is_off and _REASONS.get(code)) or self._refusals[axis],
                timed_out=self._stopped,
                rebooted=self._restarted,
            )
        self.on_status(number, replies)

    def _switch_off(self, axis: str) -> Procedure[None]:
        channel = self._channels[axis]
        self._targets[axis] = None
        yield from self._execute(f"ST{channel}")
        for _ in range(math.ceil(self.axes[axis].stop_time / _COUNTDOWN) + 1):
            if not (yield from self._read(f"_BG{channel}")):
                break
            yield Wait(lambda: False, _COUNTDOWN)
        yield from self._execute(f"MO{channel}")

    def _download(self) -> Procedure[None]:
        """Replace the controller's program with the watchdog."""
        channels = self._channels.values()
        moving = "+".join(f"_BG{channel}" for channel in channels)
        program = _WATCHDOG.format(channels="".join(channels), moving=moving).replace("\n", "\r")
        yield from self._execute("HX1")
        # The controller replies after the backslash, twice.
        yield from self._execute(f"DL\r{program}\\", end="", hint=_HINT)
        # A reply with data restores the order of the replies.
        yield from self._read("_XQ1")

    def _start_watchdog(self) -> Procedure[None]:
        yield from self._execute("HX1")
        yield from self._execute(self._beat)
        yield from self._execute("XQ#NSDOG,1", hint=_HINT)
        self._armed, self._stopped, self._restarted = True, False, False

    def _read(self, operand: str) -> Procedure[float]:
        reply = yield from self._execute(f"MG {operand}")
        if not _NUMBER.fullmatch(reply):
            raise DriveError(f"its {operand} is {reply!r}, expected a number")
        return float(reply)

    def _execute(
        self, command: str, *, end: str = "\r", may_refuse: bool = False, hint: str = ""
    ) -> Procedure[str]:
        """Send a command and return its reply.

        Raises
        ------
        DriveError
            If the controller refuses the command, or does not answer.
        """
        while self._is_asking:
            yield Wait(lambda: not self._is_asking, _COUNTDOWN)
        self._expected.append(expected := _Expected(command, asked=True))
        reply = yield from self.ask(expected, f"{command}{end}".encode())
        if reply == "?" and not may_refuse:
            name = command.partition("\r")[0]
            reason = yield from self._execute("TC1", may_refuse=True)
            raise DriveError(f"the controller refuses {name} (error {reason}){hint}")
        return reply

    def _send(self, *commands: str, axis: str = "", number: int = 0) -> None:
        self.link.send(f"{';'.join(commands)}\r".encode())
        self._expected += [_Expected(command, axis=axis, number=number) for command in commands]


BACKEND = polled_backend("galil", GalilSettings, GalilProtocol, address=lambda at: at.galil_address)
