"""Processing of a bag's inputs with the current code, to compare recorded and new outputs."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

from needle_bags.reading.bag_images import TOPICS as IMAGE_TOPICS
from needle_bags.reading.bag_images import exposures
from needle_bags.reading.bag_messages import (
    Reorder,
    SentMessage,
    messages_as_sent,
    read_contents,
)
from needle_bags.reading.bag_reader import Run, Series
from needle_bags.reading.frames import flat_fields
from needle_bags.rerun.comparison import FIELDS, Record
from needle_bags.rerun.stages import Output, Stage
from needle_bags.run.run_summary import estimate_error
from needle_controller.controller_status import received_messages
from needle_core.message_types import to_nanoseconds

POSE = "needle/tip_pose"
TIP_TOPICS = ("needle/tip", POSE)

# Answers to inputs within this time before the end of the bag may be missing from it [ns].
_END_MARGIN = 500_000_000
_STATUS = "needle/controller_status"
_STORE = get_typestore(Stores.ROS2_JAZZY)
Errors = npt.NDArray[np.float64] | None
Change = Callable[[str, Any], Iterable[tuple[str, Any]]]
"""Replaces an input (relative topic, message) by any number of others."""


@dataclasses.dataclass(frozen=True)
class Rerun:
    """Result of a rerun.

    Attributes
    ----------
    recorded, today : list of Record
        Recorded and new outputs to compare.
    outputs : list of Output
        Outputs of the current code, in order.
    tips_without_images : int
        Number of recorded tracker answers whose images are not in the bag.
    unanswered : int
        Number of recorded pairs that the tracker did not process, because it had no calibration
        yet or its queue was full. They are left out.
    """

    recorded: list[Record]
    today: list[Record]
    outputs: list[Output]
    tips_without_images: int
    unanswered: int


def has_images(run: Run) -> bool:
    """Return whether a bag has images of both cameras."""
    sides = {side for topic, side in IMAGE_TOPICS.items() if run.topics.get(run.namespace + topic)}
    return len(sides) == 2


def run_again(run: Run, tracker: Stage | None, controller: Stage) -> Rerun:
    """Process a bag with the current tracker and controller.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    tracker : Stage or None
        Processes the images; None for a bag without images.
    controller : Stage
        Processes the recorded tips.

    Returns
    -------
    Rerun
        New and recorded outputs.

    Raises
    ------
    UserError
        If the bag is broken.
    """
    watched = FIELDS.keys() - (TIP_TOPICS if tracker is None else ())
    recorded = [
        Record(topic, to_nanoseconds(message.header.stamp), flat_fields(message))
        for topic, _, message in _inputs(run, watched)
    ]
    outputs: list[Output] = []
    without_images = unanswered = 0
    if tracker is not None:
        exposed = set(exposures(run).tolist())
        # The tracker answers every pair that it receives.
        answered = set(run.tip_covariances.stamps.tolist()) or exposed
        unanswered = len(exposed - answered)
        exposed &= answered

        def received(topic: str, message: Any) -> Iterator[tuple[str, Any]]:
            is_left = IMAGE_TOPICS.get(topic) == "left"
            if not is_left or to_nanoseconds(message.header.stamp) in exposed:
                yield topic, message

        outputs += run_stage(run, tracker, change=received)
        without_images = sum(r.topic == POSE and r.stamp not in exposed for r in recorded)
        recorded = [r for r in recorded if r.topic not in TIP_TOPICS or r.stamp in exposed]
    outputs += run_stage(run, controller, _by_reception(run))
    today = [
        Record(output.topic, output.stamp, flat_fields(output.message))
        for output in _recordable(recorded, outputs, read_contents(run.path).end)
    ]
    return Rerun(recorded, today, outputs, without_images, unanswered)


def run_stage(
    run: Run, stage: Stage, reorder: Reorder | None = None, change: Change | None = None
) -> list[Output]:
    """Process a bag with one stage; return its outputs.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    stage : Stage
        Processes the messages.
    reorder : Reorder, optional
        Changes the order of the messages; by default they are in the order of sending.
    change : Change, optional
        Replaces messages before they are processed.

    Raises
    ------
    UserError
        If the bag is broken.
    """
    outputs: list[Output] = []
    last_time = 0
    for topic, sent, message in _inputs(run, stage.topics, reorder):
        last_time = max(last_time, sent.log_time)
        for name, content in change(topic, message) if change else ((topic, message),):
            outputs += stage.process(name, sent, content)
    return outputs + stage.finish(last_time)


def run_tips(run: Run, controller: Stage, answers: Sequence[Output]) -> list[Output]:
    """Process a bag with the controller, with new tips in place of the recorded ones.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    controller : Stage
        Processes the tips.
    answers : sequence of Output
        Answers of the current tracker, which replace the recorded answers with the same stamps.

    Returns
    -------
    list of Output
        Outputs of the controller.
    """
    today = {(answer.topic, answer.stamp): answer.message for answer in answers}
    answered = {answer.stamp for answer in answers}
    recorded = set(run.tips.stamps.tolist())

    def replaced(topic: str, message: Any) -> Iterator[tuple[str, Any]]:
        stamp = to_nanoseconds(message.header.stamp) if topic in TIP_TOPICS else None
        if stamp not in answered:
            yield topic, message
            return
        names = TIP_TOPICS if topic == POSE and stamp not in recorded else (topic,)
        for name in controller.topics.intersection(names):
            if (name, stamp) in today:
                yield name, today[name, stamp]

    return run_stage(run, controller, _by_reception(run), replaced)


def estimate_errors(run: Run, outputs: Sequence[Output] | None = None) -> Errors:
    """Return the RMS error of r = (x [m], beta [rad], gamma [rad]) from the truth, (3,).

    Parameters
    ----------
    run : Run
        The run, with its truth.
    outputs : sequence of Output, optional
        Outputs of the current code; by default, the recorded estimates.

    Returns
    -------
    ndarray or None
        RMS error; None without truth or estimates.
    """
    series = run.reduced_state
    if outputs is not None:
        found = [o for o in outputs if o.topic == "needle/reduced_state"]
        rows = [(v.x, v.y, v.z) for v in (output.message.vector for output in found)]
        stamps = np.array([output.stamp for output in found], np.int64)
        series = Series(stamps, np.array(rows, np.float64).reshape(-1, 3), stamps)
    _, error = estimate_error(run, series)
    if not len(error):
        return None
    rms: npt.NDArray[np.float64] = np.sqrt(np.mean(error**2, axis=0))
    return rms


def _recordable(
    recorded: Sequence[Record], outputs: Sequence[Output], end: int
) -> Iterator[Output]:
    """Yield the outputs, except those at the end for which the recording ended too early."""
    last: dict[str, int] = {}
    for record in recorded:
        last[record.topic] = max(record.stamp, last.get(record.topic, 0))
    for output in outputs:
        newer = output.stamp > last.get(output.topic, 0)
        if not (newer and output.log_time > end - _END_MARGIN):
            yield output


def _by_reception(run: Run) -> Reorder:
    return functools.partial(in_reception_order, namespace=run.namespace)


def _inputs(
    run: Run, relative: Set[str], reorder: Reorder | None = None
) -> Iterator[tuple[str, SentMessage, Any]]:
    """Yield (relative topic, raw message, message) of these topics, with a progress bar."""
    names = {name if name.startswith("/") else run.namespace + name: name for name in relative}
    messages = messages_as_sent(run.path, names.__contains__, reorder)
    bar = tqdm(
        messages,
        total=sum(run.topics.get(name, 0) for name in names),
        unit="message",
        delay=1.0,
        leave=False,
        disable=not sys.stderr.isatty(),
    )
    for sent, message in bar:
        yield names[sent.topic], sent, message


def in_reception_order(
    messages: list[SentMessage], namespace: str
) -> list[tuple[int, SentMessage]]:
    """Return the messages with their times of reception by the controller, in that order.

    Parameters
    ----------
    messages : list of SentMessage
        All small messages of a bag.
    namespace : str
        Namespace of the rig's topics; it ends with `/`.

    Returns
    -------
    list of tuple
        Time [ns] and message. The time is that of sending, or the earliest later time that keeps
        the order of reception. If no status lists a topic, its messages are received when they
        were sent. Unlisted messages are left out if a later one of the same topic is listed.
    """
    ordered = sorted(messages, key=lambda m: (m.time, m.log_time))
    received_at: dict[tuple[str, int], int] = {}
    time = 0
    for status, received in _statuses(ordered, namespace):
        for topic, sent_ns in received:
            time = max(time + 1, sent_ns)
            received_at.setdefault((namespace + topic, sent_ns), time)
        # A status follows the messages that it lists.
        time = received_at[status.topic, status.time] = max(time + 1, status.time)
    last: dict[str, int] = {}
    for topic, sent_ns in received_at:
        last[topic] = max(sent_ns, last.get(topic, 0))
    # Messages after the last status were received after it.
    rest = dict.fromkeys(last, time + 1)
    timed = [
        (received_at.get((m.topic, m.time)) or max(m.time, rest.get(m.topic, 0)), m)
        for m in ordered
        if (m.topic, m.time) in received_at or m.time >= last.get(m.topic, 0)
    ]
    # The sort is stable: messages with equal times keep the order of sending.
    return sorted(timed, key=lambda pair: pair[0])


def _statuses(
    messages: Iterable[SentMessage], namespace: str
) -> Iterator[tuple[SentMessage, list[tuple[str, int]]]]:
    for message in messages:
        if message.topic == namespace + _STATUS:
            status: Any = _STORE.deserialize_cdr(message.data, message.type_name)
            values = {pair.key: pair.value for pair in status.values}
            yield message, received_messages(values.get("heard", ""))
