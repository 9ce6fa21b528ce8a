"""Processes the inputs of a bag with the current code; collects recorded and new outputs."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Iterator, Sequence, Set
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

from needle_bags.reading.bag_images import TOPICS as IMAGE_TOPICS
from needle_bags.reading.bag_messages import Reorder, SentMessage, messages_as_sent
from needle_bags.reading.bag_reader import Run, Series, nanoseconds
from needle_bags.rerun.comparison import FIELDS, Record, members
from needle_bags.rerun.reception_order import in_reception_order
from needle_bags.run.run_summary import estimate_error
from needle_core.convert import Converter
from needle_core.message_types import rosbags_types

POSE = "needle/tip_pose"
TIP_TOPICS = ("needle/tip", POSE)

# The answers to inputs this short before the end of the bag may be missing from it [ns].
_END_MARGIN = 500_000_000
_STORE = get_typestore(Stores.ROS2_JAZZY)
CONVERTER = Converter(rosbags_types(_STORE))
"""Converts to rosbags messages."""


@dataclasses.dataclass(frozen=True)
class Output:
    """A message of the current code.

    Attributes
    ----------
    topic : str
        Relative name.
    log_time : int
        Log time of the input that caused it [ns].
    stamp : int
        Stamp of the message [ns].
    message : Any
        The message, of rosbags' class.
    """

    topic: str
    log_time: int
    stamp: int
    message: Any

    @property
    def type_name(self) -> str:
        """Name of the message's type."""
        return str(self.message.__msgtype__)

    @property
    def data(self) -> bytes:
        """The message as CDR."""
        return bytes(_STORE.serialize_cdr(self.message, self.type_name))


class Stage(Protocol):
    """A part of the rig that turns messages into outputs."""

    @property
    def topics(self) -> frozenset[str]:
        """Names of its input topics, relative to the rig's namespace, or absolute."""
        ...

    def process(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Process a message of a topic, by its relative name; return the outputs."""
        ...


class FinishingStage(Stage, Protocol):
    """A stage that may have outputs left at the end of the bag."""

    def finish(self, log_time: int) -> list[Output]:
        """Return the remaining outputs."""
        ...


@dataclasses.dataclass(frozen=True)
class Rerun:
    """Result of a rerun.

    Attributes
    ----------
    recorded, today : list of Record
        Records to compare.
    outputs : list of Output
        Outputs of the current code, in order.
    tips_without_images : int
        Number of recorded tracker answers whose images are not in the bag.
    unanswered : int
        Number of recorded pairs that the tracker never received: before it knew the cameras, or
        when its queue was full. They are left out.
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


def run_again(run: Run, tracker: FinishingStage | None, controller: Stage | None) -> Rerun:
    """Process a bag with the stages.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    tracker : FinishingStage or None
        Processes the images; None without images.
    controller : Stage or None
        Processes the recorded tips; None if no controller was recorded.

    Returns
    -------
    Rerun
        New and recorded outputs.

    Raises
    ------
    UserError
        If the bag is broken.
    """
    watched: set[str] = set()
    if tracker is not None:
        watched.update(TIP_TOPICS)
    if controller is not None:
        watched.update(topic for topic in FIELDS if topic not in TIP_TOPICS)
    recorded: list[Record] = []
    outputs: list[Output] = []
    exposed: set[int] = set()
    # The tracker answers every pair that it receives.
    answered = set(run.tip_covariances.stamps.tolist())
    without_images = last_time = unanswered = 0
    for topic, sent, message in _inputs(run, watched | _topics(tracker)):
        last_time = max(last_time, sent.log_time)
        if IMAGE_TOPICS.get(topic) == "left":
            stamp = nanoseconds(message.header.stamp)
            if answered and stamp not in answered:
                unanswered += 1
                continue
            exposed.add(stamp)
        if topic in watched:
            stamp = nanoseconds(message.header.stamp)
            recorded.append(Record(topic, stamp, dict(members(message))))
        if tracker is not None and topic in tracker.topics:
            outputs += tracker.process(topic, sent, message)
    if tracker is not None:
        outputs += tracker.finish(last_time)
        kept = [r for r in recorded if r.topic not in TIP_TOPICS or r.stamp in exposed]
        without_images = sum(record.topic == POSE for record in recorded) - sum(
            record.topic == POSE for record in kept
        )
        recorded = kept
    if controller is not None:
        for topic, sent, message in _inputs(run, controller.topics, _by_reception(run)):
            outputs += controller.process(topic, sent, message)
    today = [
        Record(o.topic, o.stamp, dict(members(o.message)))
        for o in _recordable(recorded, outputs, last_time)
    ]
    return Rerun(recorded, today, outputs, without_images, unanswered)


def run_stage(run: Run, stage: FinishingStage) -> list[Output]:
    """Process a bag with one stage, in the order of sending; return its outputs.

    Raises
    ------
    UserError
        If the bag is broken.
    """
    outputs: list[Output] = []
    last_time = 0
    for topic, sent, message in _inputs(run, stage.topics):
        last_time = max(last_time, sent.log_time)
        outputs += stage.process(topic, sent, message)
    return outputs + stage.finish(last_time)


def run_tips(run: Run, controller: Stage, answers: Sequence[Output]) -> list[Output]:
    """Process the joints of a bag with the controller, and tips that replace the recorded ones.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    controller : Stage
        Processes the tips.
    answers : sequence of Output
        Answers of the current tracker; they replace the recorded answers of the same stamps.

    Returns
    -------
    list of Output
        Outputs of the controller.
    """
    today = {(answer.topic, answer.stamp): answer.message for answer in answers}
    answered = {answer.stamp for answer in answers}
    recorded = set(run.tips.stamps.tolist())
    outputs: list[Output] = []
    for topic, sent, message in _inputs(run, controller.topics, _by_reception(run)):
        stamp = nanoseconds(message.header.stamp) if topic in TIP_TOPICS else 0
        if topic not in TIP_TOPICS or stamp not in answered:
            taken = {topic: message}
        elif topic == POSE and stamp not in recorded:
            taken = {name: today.get((name, stamp)) for name in TIP_TOPICS}
        else:
            taken = {topic: today.get((topic, stamp))}
        for name, content in taken.items():
            if name in controller.topics and content is not None:
                outputs += controller.process(name, sent, content)
    return outputs


def estimate_errors(run: Run, outputs: Sequence[Output] | None) -> npt.NDArray[np.float64] | None:
    """Return the RMS error of r = (x [m], beta [rad], gamma [rad]) against the truth, (3,).

    Parameters
    ----------
    run : Run
        The run, with its truth.
    outputs : sequence of Output or None
        Outputs of the current code; None for the recorded estimates.

    Returns
    -------
    ndarray or None
        None without truth or estimates.
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
    """Yield the outputs except those at the end that the bag could not record any more."""
    last: dict[str, int] = {}
    for record in recorded:
        last[record.topic] = max(record.stamp, last.get(record.topic, 0))
    for output in outputs:
        newer = output.stamp > last.get(output.topic, 0)
        if not (newer and output.log_time > end - _END_MARGIN):
            yield output


def _topics(stage: Stage | None) -> frozenset[str]:
    return frozenset() if stage is None else stage.topics


def _by_reception(run: Run) -> Reorder:
    return functools.partial(in_reception_order, namespace=run.namespace)


def _inputs(
    run: Run, relative: Set[str], reorder: Reorder | None = None
) -> Iterator[tuple[str, SentMessage, Any]]:
    """Yield (relative topic, raw message, message) of these topics, with a progress bar."""
    names = {name if name.startswith("/") else run.namespace + name: name for name in relative}
    messages = messages_as_sent(
        run.path, lambda name: name in names, lambda name: names[name] in IMAGE_TOPICS, reorder
    )
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
