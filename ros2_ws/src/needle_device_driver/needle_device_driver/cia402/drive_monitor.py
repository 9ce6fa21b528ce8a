"""Frames that one drive sends: process data, heartbeats, emergencies."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.objects import (
    EMCY,
    HEARTBEAT,
    NMT_BOOT_UP,
    NMT_OPERATIONAL,
    POSITION,
    STATUS,
    Pdo,
)

_ANSWER = (STATUS.function_code, POSITION.function_code)
# One answer may be lost. If more are missing, the next one may answer a much earlier SYNC.
_MAX_MISSING = 1
# Number of SYNCs after which an earlier loss is forgotten.
_FORGET_AFTER = 25
_STATUS_NAMES, _POSITION_NAMES = ("statusword", "mode", "inputs"), ("position", "following_error")


@dataclasses.dataclass(frozen=True)
class Feedback:
    """The newest process data of a drive.

    Attributes
    ----------
    number : int
        Number of complete answers to a SYNC.
    statusword, mode, inputs : int
        Values as sent.
    position : int
        Position actual value [counts].
    following_error : int
        Position demand of the drive minus position [counts]; 0 if the drive does not report
        it.
    syncs : int
        Number of SYNCs that were sent before the data arrived.
    time : float
        Steady time of its arrival [s].
    """

    number: int = 0
    statusword: int = 0
    mode: int = 0
    inputs: int = 0
    position: int = 0
    following_error: int = 0
    syncs: int = 0
    time: float = 0.0

    def periods_since(self, before: Feedback, period: float) -> int:
        """Return how many SYNC periods of `period` [s] lie between two answers.

        It is the greatest of three counts: SYNCs sent, answers received, and elapsed time. Answers
        may be lost or late, and after a late SYNC the axis has moved farther.
        """
        elapsed = round((self.time - before.time) / period)
        return max(1, self.syncs - before.syncs, self.number - before.number, elapsed)


class DriveMonitor:
    """Receives the frames of one node and measures their age.

    The age of process data counts from its arrival. If it answers the last SYNC, nothing newer was
    requested, and each heartbeat renews it: positions stay fresh while simulated time stands still,
    and become stale as soon as a SYNC is unanswered.

    An answer does not identify its SYNC, so the monitor counts them. While two earlier SYNCs are
    unanswered, an answer counts as late and renews nothing. A pause without SYNCs shows which
    answers are lost.

    Parameters
    ----------
    link : FrameLink
        The bus.
    node_id : int
        The node.

    Attributes
    ----------
    feedback : Feedback
        The newest process data.
    heartbeats : int
        Number of heartbeats since the last set-up began.
    nmt_state : int
        Last NMT state in a heartbeat.
    rebooted : bool
        Whether the node sent a boot-up message since the last set-up.
    emergency : int or None
        The first error code of the node.
    """

    def __init__(self, link: FrameLink, node_id: int) -> None:
        self._link = link
        self._answers: set[int] = set()
        self._syncs = self._all_syncs = 0
        self._received = dict.fromkeys(_ANSWER, 0)
        self._fresh_time = -math.inf
        self._heartbeat_time = -math.inf
        self.nmt_state = NMT_BOOT_UP
        self._is_set_up = False
        self._outdated = False
        self.feedback = Feedback()
        self.heartbeats = 0
        self.rebooted = False
        self.emergency: int | None = None
        for function_code, handler in (
            (STATUS.function_code, partial(self._on_answer, STATUS, _STATUS_NAMES)),
            (POSITION.function_code, partial(self._on_answer, POSITION, _POSITION_NAMES)),
            (HEARTBEAT, self._on_heartbeat),
            (EMCY, self._on_emergency),
        ):
            link.subscribe(function_code + node_id, partial(self._receive, handler))

    @property
    def fresh_since(self) -> float:
        """Steady time from which the age of the feedback counts [s]."""
        if self._is_waiting or self.nmt_state != NMT_OPERATIONAL:
            return self._fresh_time
        return max(self._fresh_time, self._heartbeat_time)

    @property
    def left_operational(self) -> bool:
        """Whether the node's heartbeat reports another NMT state than operational."""
        return self._is_set_up and self.nmt_state != NMT_OPERATIONAL

    def answered(self) -> bool:
        """Return whether the answer to the last SYNC is complete and not late."""
        return not self._is_waiting

    @property
    def outstanding(self) -> int:
        """Number of unanswered SYNCs, or 0 if at most one before the last is unanswered."""
        return self._syncs - min(self._received.values()) if self._is_behind else 0

    def discard_outstanding(self) -> None:
        """Treat the outstanding answers as lost."""
        self._syncs = 0
        self._received = dict.fromkeys(_ANSWER, 0)

    def expect_answer(self) -> None:
        """Note that a SYNC is sent now."""
        self._fresh_time = self.fresh_since
        self._answers.clear()
        if self._syncs >= _FORGET_AFTER and not self._is_behind:
            self.discard_outstanding()
        self._syncs += 1
        self._all_syncs += 1

    def begin_set_up(self) -> None:
        """Note that the set-up of the node begins."""
        self._is_set_up = False
        self.heartbeats = 0

    def clear_reboot(self) -> None:
        """Note that the node answers; a later boot-up message is another reboot."""
        self.rebooted = False

    def end_set_up(self) -> None:
        """Note that the node is set up: from now on it must stay operational."""
        self._is_set_up = True
        self.emergency = None

    def set_feedback(self, statusword: int, mode: int, inputs: int, position: int) -> None:
        """Use values that were read by SDO as the newest process data.

        Some drives answer a SYNC with data from the previous SYNC. So the next answer counts as an
        answer, but its data are older than these values.
        """
        self._answers = set(_ANSWER)
        self.discard_outstanding()
        self._outdated = True
        self._fresh_time = now = self._link.now
        number = self.feedback.number + 1
        self.feedback = Feedback(
            number, statusword, mode, inputs, position, syncs=self._all_syncs, time=now
        )

    @property
    def _is_waiting(self) -> bool:
        return len(self._answers) < len(_ANSWER) or self._is_behind

    @property
    def _is_behind(self) -> bool:
        outstanding = self._syncs - min(self._received.values())
        # The answer to the last SYNC may still be in transit.
        return outstanding - (len(self._answers) < len(_ANSWER)) > _MAX_MISSING

    def _answer(self, function_code: int, time: float) -> None:
        self._answers.add(function_code)
        # Some drives send more answers than SYNCs.
        self._received[function_code] = min(self._received[function_code] + 1, self._syncs)
        if not self._is_waiting:
            number = self.feedback.number + (not self._outdated)
            self._outdated = False
            self._fresh_time = time
            self._update(number=number, syncs=self._all_syncs, time=time)

    def _update(self, **values: Any) -> None:
        self.feedback = dataclasses.replace(self.feedback, **values)

    def _receive(self, handler: Callable[[bytes, float], None], data: bytes, time: float) -> None:
        try:
            handler(data, time)
        except ValueError:
            # The frame has the wrong length.
            self._link.bus_errors += 1

    def _on_answer(self, pdo: Pdo, names: tuple[str, ...], data: bytes, time: float) -> None:
        self._update(**dict(zip(names, pdo.unpack(data), strict=False)))
        self._answer(pdo.function_code, time)

    def _on_heartbeat(self, data: bytes, time: float) -> None:
        (state,) = data
        self.heartbeats += 1
        self._heartbeat_time = time
        # The upper bit toggles in the older protocol, node guarding.
        self.nmt_state = state & 0x7F
        if self.nmt_state == NMT_BOOT_UP:
            self.rebooted = True

    def _on_emergency(self, data: bytes, _: float) -> None:
        lower, upper, *_rest = data
        code = lower | upper << 8
        if code and self.emergency is None:
            self.emergency = code
