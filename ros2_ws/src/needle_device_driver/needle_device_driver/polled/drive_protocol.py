"""Interface of a drive that answers requests; backends implement it without safety rules."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Hashable, Mapping
from typing import Any, ClassVar

from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.link import DriveError, LinkError
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, Wait

# While a procedure waits for an answer, it feeds the watchdog with this period [s].
_BEAT_PERIOD = 0.02


@dataclasses.dataclass(frozen=True)
class DriveReply:
    """State of a drive in its answer to a request; counts are the drive's own.

    Attributes
    ----------
    position : int
        Measured position, or the number of its own steps [counts].
    moving : bool
        Whether it executes an order.
    powered : bool
        Whether it is able to move.
    home_switch, inner_switch : bool
        Whether the outer and the inner limit switch are active.
    fault : str
        Why it refuses to move or refused an order, worded to follow "the drive"; empty: no fault,
        or its watchdog has stopped it.
    timed_out : bool
        Whether its watchdog has stopped it.
    rebooted : bool
        Whether it has lost its set-up.
    conflict : bool
        Whether it stopped because an order was lost or came from another program.
    """

    position: int
    moving: bool
    powered: bool
    home_switch: bool = False
    inner_switch: bool = False
    fault: str = ""
    timed_out: bool = False
    rebooted: bool = False
    conflict: bool = False


class DriveProtocol(abc.ABC):
    """The protocol of all drives behind one connection.

    Orders are queued on the link and return at once; procedures wait for answers and raise
    `DriveError` and `LinkError`. The procedures of both axes run side by side, but send one request
    at a time, so that both may use the same key.

    Parameters
    ----------
    parameters : object
        All parameters of device_driver.
    axes : mapping of str to AxisSettings
        Insertion, rotation or both.
    link : TextLink
        The connection.

    Attributes
    ----------
    capabilities : Capabilities
        Abilities of the drives.
    terminators : bytes
        Each of these bytes ends a line.
    parameters, axes, link
        The arguments.
    on_status : callable
        Call it once per request with its number and the states by axis, when all answers have
        arrived, however late.
    """

    capabilities: ClassVar[Capabilities]
    terminators: ClassVar[bytes] = b"\n"

    def __init__(self, parameters: Any, axes: Mapping[str, AxisSettings], link: TextLink) -> None:
        self.parameters, self.axes, self.link = parameters, axes, link
        self.on_status: Callable[[int, Mapping[str, DriveReply]], None] = lambda _, __: None
        self._answers: dict[Hashable, str] = {}
        self._is_asking = False

    # ---- procedures ---------------------------------------------------------------------------

    @abc.abstractmethod
    def identify(self) -> Procedure[str]:
        """Return name and version, and resynchronize a reopened connection.

        The drive may hold a partial line: end it so that the drive rejects it. The name of an
        emulator begins with "Emulated".
        """

    @abc.abstractmethod
    def set_up(self, axis: str) -> Procedure[None]:
        """Write all settings and a marker of this set-up; the drive is off afterwards.

        It moves nothing. A drive that has lost its marker has restarted: the state is read before a
        new set-up. For a setting that the drive cannot have, raise `DriveError` with its bound.
        """

    @abc.abstractmethod
    def clear_fault(self, axis: str) -> Procedure[None]:
        """Acknowledge a fault; moves nothing."""

    def write_limits(self, axis: str, lower: int, upper: int) -> Procedure[None]:
        """Set the software limits [counts], if the drive has any."""
        yield from ()

    @abc.abstractmethod
    def release(self, axis: str) -> Procedure[None]:
        """Switch the drive off, and with the last axis the watchdog that both share."""

    # ---- orders -------------------------------------------------------------------------------

    @abc.abstractmethod
    def power(self, axis: str, on: bool) -> None:
        """Switch the drive on, holding its present position, or off."""

    @abc.abstractmethod
    def move_to(self, axis: str, position: int, speed: int) -> None:
        """Move to the set-point of the next cycle [counts] at `speed` [counts/s]; end there."""

    @abc.abstractmethod
    def stop(self, axis: str) -> None:
        """Stop as fast as possible and discard the set-point."""

    def beat(self) -> None:  # noqa: B027 - a drive without a watchdog needs none
        """Feed the watchdog, if there is one: in each cycle of 20 ms, and while `ask` waits."""

    @abc.abstractmethod
    def request(self, number: int) -> None:
        """Request the state of all drives; the answer has this number, 1..99.

        The next request follows when this one is answered, or lost after three cycles.
        """

    # ---- answers ------------------------------------------------------------------------------

    @abc.abstractmethod
    def on_line(self, line: str) -> None:
        """Handle a line, which ends with its terminator; ignore any other text.

        An exception is an internal error and stops both axes.
        """

    def ask(self, key: Hashable, data: bytes, timeout: float = 0.5) -> Procedure[str]:
        """Send a request, wait for its `answer`, and return it.

        Parameters
        ----------
        key : hashable
            Identifies request and answer.
        data : bytes
            The request.
        timeout : float
            Longest wait [s].

        Raises
        ------
        DriveError
            If there is no answer.
        LinkError
            If the link is lost.
        """
        # The procedures of both axes share the connection.
        while self._is_asking:
            yield Wait(lambda: not self._is_asking, timeout)
        self._is_asking = True
        try:
            self._answers.pop(key, None)
            self.link.send(data)
            end = self.link.now + timeout
            while key not in self._answers:
                if self.link.lost:
                    raise LinkError(self.link.lost)
                if self.link.now >= end:
                    request = data.decode(errors="replace").strip()
                    raise DriveError(f"{self.link.name}: no answer to {request!r} in {timeout:g} s")
                self.beat()
                yield Wait(lambda: key in self._answers or bool(self.link.lost), _BEAT_PERIOD)
            return self._answers.pop(key)
        finally:
            self._is_asking = False

    def answer(self, key: Hashable, text: str) -> None:
        """Pass an answer to the `ask` with this key; any other is ignored."""
        self._answers[key] = text
