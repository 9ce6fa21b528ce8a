"""Step/direction board for two stepper motors without encoders; it runs `stepdir.ino`."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from functools import reduce
from typing import Any

from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.link import DriveError
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.polled.polled_drives import polled_backend
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, Wait

# Number of each axis on the board, bits of the state of an axis, and faults.
_AXES = {"insertion": 0, "rotation": 1}
_ON, _MOVING, _OUTER, _INNER, _SET_UP = 1, 2, 4, 8, 16
_DEAD_MAN, _LINE_LOST = 1, 2
_LINE = re.compile(r"\$((\d+),([A-Z])(.*))\*([0-9A-F]{2})\n")
_VERSION = "1"


@dataclasses.dataclass(frozen=True)
class StepdirSettings:
    """Parameters of the board."""

    stepdir_address: str = fixed_parameter(
        "/dev/ttyACM0", "-", "Serial port of the step/direction board, or host:port."
    )


class StepdirProtocol(DriveProtocol):
    """Protocol of the board; the lines are numbered, so that the board detects a lost one.

    Parameters
    ----------
    parameters, axes, link
        As in `DriveProtocol`.
    """

    capabilities = Capabilities(
        watchdog=0.1,
        longest_order=0.05,
        response_time=0.02,
        encoder=False,
        switches=True,
        limits=False,
        identity=True,
        exclusive=True,
    )

    def __init__(self, parameters: Any, axes: Mapping[str, AxisSettings], link: TextLink) -> None:
        super().__init__(parameters, axes, link)
        self._next = 0
        # Line number of a state request -> number of the request.
        self._requests: dict[int, int] = {}
        self._max_rate = 0

    def identify(self) -> Procedure[str]:
        """Return name and version; store the largest step rate."""
        # End a partial line that was sent earlier.
        self.link.send(b"\n")
        answer = yield from self._ask("I")
        _, name, version, rate = answer.split(",") if answer.count(",") == 3 else ("", "", "", "")
        if version != _VERSION:
            raise DriveError(
                f"{self.link.name} answers {answer!r}, not version {_VERSION}: load the sketch of "
                "this package onto the board"
            )
        self._max_rate = int(rate)
        return f"{name} {version}"

    def set_up(self, axis: str) -> Procedure[None]:
        """Switch off, clear a fault, and set ramp and direction of the outer switch."""
        settings = self.axes[axis]
        rate = settings.magnitude(settings.speed)
        if rate > self._max_rate:
            raise DriveError(
                f"{settings.text(settings.speed)}/s are {rate} steps/s, limit {self._max_rate} of "
                f"the board: reduce {axis}_counts_per_unit (microsteps) or the greatest speed"
            )
        self.power(axis, False)
        yield from self._ask("R")
        ramp = settings.magnitude(settings.quick_stop_deceleration)
        dead_man = round(self.parameters.watchdog * 1e3)
        yield from self._ask("C", _AXES[axis], ramp, -settings.direction, dead_man)

    def clear_fault(self, axis: str) -> Procedure[None]:
        """Reset the fault of the board."""
        yield from self._ask("R")

    def release(self, axis: str) -> Procedure[None]:
        """Switch off; the dead-man acts only while a motor is on."""
        self.power(axis, False)
        yield from ()

    def power(self, axis: str, on: bool) -> None:
        """Switch a motor on or off."""
        self._send("P", _AXES[axis], int(on))

    def move_to(self, axis: str, position: int, speed: int) -> None:
        """Move to the set-point within one cycle; the board makes up for a delay."""
        self._send("M", _AXES[axis], position, round(PERIOD * 1e3))

    def stop(self, axis: str) -> None:
        """Brake with the ramp."""
        self._send("H", _AXES[axis])

    def beat(self) -> None:
        """Feed the dead-man."""
        self._send("B")

    def request(self, number: int) -> None:
        """Request the state."""
        self._requests[self._next] = number
        self._send("S")

    def on_line(self, line: str) -> None:
        """Handle an answer."""
        match = _LINE.fullmatch(line)
        if match is None or _checksum(match[1]) != int(match[5], 16):
            return
        number = int(match[2])
        if match[3] != "S":
            self.answer(number, match[4])
        elif (request := self._requests.pop(number, None)) is not None:
            fault, *fields = map(int, match[4].split(",")[1:])
            self.on_status(
                request, {name: _reply(fault, *fields[2 * _AXES[name] :][:2]) for name in self.axes}
            )

    def _ask(self, letter: str, *values: int) -> Procedure[str]:
        # Number the line only when it is sent.
        while self._is_asking:
            yield Wait(lambda: not self._is_asking, PERIOD)
        number = self._next
        return (yield from self.ask(number, self._line(letter, *values)))

    def _send(self, letter: str, *values: int) -> None:
        self.link.send(self._line(letter, *values))

    def _line(self, letter: str, *values: int) -> bytes:
        text = ",".join(map(str, (self._next, letter, *values)))
        self._next = (self._next + 1) % 256
        return f"${text}*{_checksum(text):02X}\n".encode()


def _reply(fault: int, position: int, flags: int) -> DriveReply:
    return DriveReply(
        position,
        moving=bool(flags & _MOVING),
        powered=bool(flags & _ON),
        home_switch=bool(flags & _OUTER),
        inner_switch=bool(flags & _INNER),
        fault="" if fault in (0, _DEAD_MAN, _LINE_LOST) else f"reports fault {fault}",
        timed_out=fault == _DEAD_MAN,
        rebooted=not flags & _SET_UP,
        conflict=fault == _LINE_LOST,
    )


def _checksum(text: str) -> int:
    return reduce(lambda total, character: total ^ ord(character), text, 0)


BACKEND = polled_backend(
    "stepdir", StepdirSettings, StepdirProtocol, address=lambda its: its.stepdir_address
)
