"""Images and joint states in, one answer for every stereo pair out: what the tracker's node does.

An answer depends on what came, in what order, and not on when: but for `joint_timeout`, after which
a pair no longer waits for the joint state that follows it. Times are steady, and arguments. Where
the needle was before the first joint state is never heard: a pair exposed before it has no answer,
whichever of both came first.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from needle_tracker.answers.swapped_images import SwapWatch
from needle_tracker.filter.measurement import Measurement
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.filter.settings import TrackerSettings
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.sources.insertion_history import InsertionHistory
from needle_tracker.sources.pairing import Pair, PairMatcher

_NEW_RECORDING = 1_000_000_000  # [ns]: a longer step back in time begins a new recording


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image as it came: `pixels` (shared with the message), or what is wrong with it."""

    pixels: NDArray[np.uint8] | None
    problem: str = ""


@dataclasses.dataclass(frozen=True)
class Answer:
    """Result of a pair.

    Attributes
    ----------
    pair : Pair of Frame
        The images.
    arrival : float
        When the pair was complete [s], steady clock.
    measured : Measurement
        What the tracker says.
    refused : str
        Why the pair was not looked at; empty where it was.
    """

    pair: Pair[Frame]
    arrival: float
    measured: Measurement
    refused: str


class PairAnswers:
    """Pairs images by stamp, joins the insertion at that stamp, answers the pairs in order.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    tracker : TrackerSettings
        The tracker's settings.
    pair_tolerance_ns : int or None
        Largest difference of the stamps of a pair [ns]; None of cameras that run freely.
    joint_timeout : float
        How long a pair waits for the joint state that follows it [s], steady clock.

    Attributes
    ----------
    unanswered : int
        Pairs exposed before the first joint state.
    too_early : int
        How long before it the last pair was exposed [ns]; 0 if that pair is answered.
    """

    def __init__(
        self,
        calibration: StereoCalibration,
        tracker: TrackerSettings,
        *,
        pair_tolerance_ns: int | None,
        joint_timeout: float,
    ) -> None:
        self.tracker = NeedleTracker(calibration, tracker)
        self.tracker.warm_up()
        self.swap = SwapWatch(calibration, tracker)
        self.matcher: PairMatcher[Frame] = PairMatcher(pair_tolerance_ns)
        self.insertions = InsertionHistory()
        self.joints_silent = False
        self.unanswered = self.too_early = 0
        self._joint_timeout = joint_timeout
        self._queue: deque[tuple[float, Pair[Frame]]] = deque()
        self._last_stamp: int | None = None
        self._contradictions: dict[str, str] = {}

    def add_image(self, side: str, stamp: int, frame: Frame, now: float) -> Iterator[Answer]:
        """Take an image of one side, exposed at `stamp` [ns]; then as `ready`."""
        pair = self.matcher.add(side, stamp, frame)
        if pair is not None:
            self._queue.append((now, pair))
        return self.ready(now)

    def add_contradiction(self, side: str, reason: str) -> None:
        """Refuse all pairs while a side's camera is not the calibrated one; empty: it is."""
        self._contradictions[side] = reason

    def add_insertion(self, stamp: int, insertion: float, now: float) -> Iterator[Answer]:
        """Take an insertion [m] sampled at `stamp` [ns]; then as `ready`."""
        self.joints_silent = False
        self.insertions.add(stamp, insertion)
        return self.ready(now)

    def ready(self, now: float) -> Iterator[Answer]:
        """Yield the answers, in order, to all pairs whose insertion is settled.

        Each pair is looked at when its answer is asked for: the first need not wait for the rest.
        """
        while self._queue:
            arrival, pair = self._queue[0]
            self.too_early = 0 if self.joints_silent else self.insertions.time_before(pair.stamp)
            if self.too_early:
                self.unanswered += 1
                self._queue.popleft()
                continue
            if not (self.joints_silent or self.insertions.is_bracketed(pair.stamp)):
                if now - arrival < self._joint_timeout:
                    return
                self.joints_silent = True
            self._queue.popleft()
            answer = self._answer(arrival, pair)
            yield answer
            # No answer waits for a suspicion.
            self._suspect(answer)

    def _answer(self, arrival: float, pair: Pair[Frame]) -> Answer:
        refused = self._refusal(pair)
        left, right = pair.left.pixels, pair.right.pixels
        if refused or left is None or right is None:
            measured = self.tracker.skip(refused)
        else:
            measured = self.tracker.process(left, right, self.insertions.at(pair.stamp))
        return Answer(pair, arrival, measured, refused)

    def _suspect(self, answer: Answer) -> None:
        """Look whether the images seem to be swapped."""
        pair = answer.pair
        left, right = pair.left.pixels, pair.right.pixels
        if left is not None and right is not None and not answer.refused:
            self.swap.see(left, right, self.insertions.at(pair.stamp), answer.measured)

    def _refusal(self, pair: Pair[Frame]) -> str:
        """Return why a pair cannot be looked at; a long step back in time begins anew."""
        last = self._last_stamp
        if last is None or pair.stamp > last:
            self._last_stamp = pair.stamp
            problems = (pair.left.problem, pair.right.problem, *self._contradictions.values())
            return next(filter(None, problems), "")
        back = last - pair.stamp
        if back >= _NEW_RECORDING:
            self.tracker.reset()
            self._last_stamp = pair.stamp
        return "time of exposure ran backwards" if back else "time of exposure repeated"
