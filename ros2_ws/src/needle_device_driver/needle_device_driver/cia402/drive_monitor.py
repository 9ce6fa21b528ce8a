"""Frames that one drive sends by itself, each with the time of its arrival."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial

from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.objects import (
    EMCY,
    HEARTBEAT,
    NMT_BOOT_UP,
    NMT_OPERATIONAL,
    POSITION,
    POSITION_ALONE,
    STATUS,
    STATUS_WITHOUT_INPUTS,
)
from needle_device_driver.procedure import Procedure, Wait

_ANSWER = (STATUS.function_code, POSITION.function_code)
# One answer may be lost; with more missing, what comes may be an answer to a SYNC of long ago.
_MAY_LACK = 1
_FORGIVEN_AFTER = 25

_LENGTH_WITHOUT_INPUTS = len(STATUS_WITHOUT_INPUTS.pack(0, 0))
_LENGTH_ALONE = len(POSITION_ALONE.pack(0))


@dataclasses.dataclass(frozen=True)
class Feedback:
    """The newest process data of a drive.

    Attributes
    ----------
    number : int
        Counts complete answers to a SYNC.
    statusword, mode, inputs : int
        As sent.
    position : int
        Position actual value [counts].
    following_error : int
        How far the axis is short of where its drive wants it [counts]; 0 of a drive that does not
        tell.
    syncs : int
        Counts the SYNCs that were sent until it came.
    time : float
        When it came, steady clock [s].
    """

    number: int
    statusword: int
    mode: int
    inputs: int
    position: int
    following_error: int
    syncs: int = 0
    time: float = 0.0


class DriveMonitor:
    """Listens to one node, and ages what it hears.

    Process data is as old as its arrival, unless it answers the last SYNC that was sent: then
    nothing newer was asked for, and a heartbeat keeps it fresh. So positions do not grow stale
    while a simulation's time stands still, and do as soon as a SYNC stays unanswered.

    An answer does not say which SYNC it answers, so they are counted: one that comes while two
    earlier SYNCs are unanswered is taken for a late one, which keeps nothing fresh, until a pause
    has shown that what is missing does not come any more.

    Parameters
    ----------
    link : FrameLink
        The bus.
    node_id : int
        Whose frames.
    """

    def __init__(self, link: FrameLink, node_id: int) -> None:
        self._link = link
        self._number = 0
        self._statusword = self._mode = self._inputs = self._position = 0
        self._following_error = 0
        self._answers: set[int] = set()
        self._syncs = self._all_syncs = 0
        self._taken = 0, 0.0
        self._received = dict.fromkeys(_ANSWER, 0)
        self._fresh_time = -math.inf
        self._heartbeat_time = -math.inf
        self._heartbeats = 0
        self._nmt_state = NMT_BOOT_UP
        self._watching = False
        self._outdated = False
        self.rebooted = False
        self.emergency: int | None = None
        for function_code, handler in (
            (STATUS.function_code, self._on_status),
            (POSITION.function_code, self._on_position),
            (HEARTBEAT, self._on_heartbeat),
            (EMCY, self._on_emergency),
        ):
            link.subscribe(function_code + node_id, partial(self._take, handler))

    @property
    def feedback(self) -> Feedback:
        """The newest process data."""
        return Feedback(
            self._number,
            self._statusword,
            self._mode,
            self._inputs,
            self._position,
            self._following_error,
            *self._taken,
        )

    @property
    def fresh_time(self) -> float:
        """Time at which the drive last said where it is, steady clock [s]."""
        return self._age_base()

    @property
    def left_operational(self) -> bool:
        """Tell whether the node's own heartbeat says that it no longer exchanges process data."""
        return self._watching and self._nmt_state != NMT_OPERATIONAL

    @property
    def heartbeats(self) -> int:
        """Number of heartbeats since the last set-up began."""
        return self._heartbeats

    def answered(self) -> bool:
        """Return whether all process data arrived since the last SYNC, and in its time."""
        return not self._awaited()

    @property
    def outstanding(self) -> int:
        """Number of unanswered SYNCs, if too many before the last are; else 0."""
        return self._syncs - min(self._received.values()) if self._is_behind() else 0

    def give_up(self) -> None:
        """Take what is outstanding for lost."""
        self._count_anew()

    def expect_answer(self) -> None:
        """Take note that a SYNC goes out now."""
        self._fresh_time = self._age_base()
        self._answers.clear()
        if self._syncs >= _FORGIVEN_AFTER and not self._is_behind():
            self._count_anew()
        self._syncs += 1
        self._all_syncs += 1

    def begin_set_up(self) -> None:
        """Forget what was; the node is set up from the start."""
        self._watching = False
        self._heartbeats = 0

    def forget_start(self) -> None:
        """Take note that the node answers: a start that it tells of from now on is another one."""
        self.rebooted = False

    def end_set_up(self) -> None:
        """Watch over the node from now on."""
        self._watching = True
        self.emergency = None

    def take(self, statusword: int, mode: int, inputs: int, position: int) -> None:
        """Take what was read on request as if it had been sent.

        The next answer to a SYNC is older in some drives, which answer with what they sampled at
        the SYNC before: it counts as an answer, not for what it says.
        """
        self._statusword, self._mode, self._inputs = statusword, mode, inputs
        self._position, self._following_error = position, 0
        self._answers = set(_ANSWER)
        self._count_anew()
        self._number += 1
        self._outdated = True
        self._fresh_time = self._link.now
        self._taken = self._all_syncs, self._fresh_time

    def await_operational(self, before: int, timeout: float) -> Procedure[bool]:
        """Return whether, within `timeout` [s], one after `before` heartbeats says: operational."""
        yield Wait(lambda: self._heartbeats > before, timeout)
        return self._heartbeats > before and self._nmt_state == NMT_OPERATIONAL

    def _awaited(self) -> bool:
        return len(self._answers) < len(_ANSWER) or self._is_behind()

    def _is_behind(self) -> bool:
        outstanding = self._syncs - min(self._received.values())
        # The answer to the last SYNC may be on its way.
        return outstanding - (len(self._answers) < len(_ANSWER)) > _MAY_LACK

    def _count_anew(self) -> None:
        self._syncs = 0
        self._received = dict.fromkeys(_ANSWER, 0)

    def _age_base(self) -> float:
        if self._awaited() or self._nmt_state != NMT_OPERATIONAL:
            return self._fresh_time
        return max(self._fresh_time, self._heartbeat_time)

    def _answer(self, function_code: int, time: float) -> None:
        self._answers.add(function_code)
        # Some drives say more than they are asked.
        self._received[function_code] = min(self._received[function_code] + 1, self._syncs)
        if not self._awaited():
            self._number += not self._outdated
            self._outdated = False
            self._fresh_time = time
            self._taken = self._all_syncs, time

    def _take(self, handler: Callable[[bytes, float], None], data: bytes, time: float) -> None:
        """Take a frame; one that is not as its kind must be is counted by the link."""
        try:
            handler(data, time)
        except ValueError:
            self._link.error_frames += 1
            return

    def _on_status(self, data: bytes, time: float) -> None:
        if len(data) == _LENGTH_WITHOUT_INPUTS:
            self._statusword, self._mode = STATUS_WITHOUT_INPUTS.unpack(data)
        else:
            self._statusword, self._mode, self._inputs = STATUS.unpack(data)
        self._answer(STATUS.function_code, time)

    def _on_position(self, data: bytes, time: float) -> None:
        if len(data) == _LENGTH_ALONE:
            (self._position,) = POSITION_ALONE.unpack(data)
        else:
            self._position, self._following_error = POSITION.unpack(data)
        self._answer(POSITION.function_code, time)

    def _on_heartbeat(self, data: bytes, time: float) -> None:
        (state,) = data
        self._heartbeats += 1
        self._heartbeat_time = time
        # The upper bit toggles in the older protocol, node guarding.
        self._nmt_state = state & 0x7F
        if self._nmt_state == NMT_BOOT_UP:
            self.rebooted = True

    def _on_emergency(self, data: bytes, _: float) -> None:
        lower, upper, *_rest = data
        code = lower | upper << 8
        if code and self.emergency is None:
            self.emergency = code
