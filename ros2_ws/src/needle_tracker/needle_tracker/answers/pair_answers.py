"""Core of the tracker node: images and joint states in, one answer for every stereo pair out.

An answer depends on the messages and their order, not on the time of their arrival, except for
`joint_timeout`: after that, a pair no longer waits for the joint state that follows it. Times are
steady times and passed as arguments. A pair exposed before the first joint state has no answer,
since its insertion remains unknown.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.filter.needle_tracker import Image, NeedleTracker
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.sources.image_encodings import Frame
from needle_tracker.sources.pairing import InsertionHistory, Pair, PairMatcher
from needle_tracker.tracker_parameters import StereoTrackerParameters

SUSPICION = "left and right images seem to be swapped: exchanged, they show a needle"
_NEW_RECORDING = 1_000_000_000  # a longer step back in time begins a new recording [ns]
# Consecutive pairs without a tip before the first check, pairs per check, period of the checks.
_BEFORE, _CHECKED, _PERIOD = 5, 10, 20
_AGREEING = 4  # consecutive pairs that must show a needle when swapped


class SwapWatch:
    """Detector of swapped left and right images, such as from exchanged cables.

    Both images of a swapped pair show the needle, but the ends do not meet, so that no tip is
    found. Only then, and only for some of the pairs, a second tracker processes the swapped images.
    Its result raises a suspicion and is never published as a tip.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : StereoTrackerParameters
        Parameters of the tracker.

    Attributes
    ----------
    suspected : bool
        Whether the last pairs show a needle only when swapped; reset by a tip.
    """

    def __init__(self, calibration: StereoCalibration, settings: StereoTrackerParameters) -> None:
        left, right = calibration.left, calibration.right
        # Swapped images of different sizes are rejected by their size.
        self._can_check = (left.height, left.width) == (right.height, right.width)
        self._calibration = calibration
        self._settings = settings
        self._swapped: NeedleTracker | None = None
        self._missed = 0
        self._agreeing = 0
        self.suspected = False

    def update(
        self, left: Image, right: Image, insertion: float | None, measured: Measurement
    ) -> None:
        """Process a pair and its measurement.

        Parameters
        ----------
        left, right : ndarray of uint8, shape (height, width)
            The pair.
        insertion : float or None
            Insertion at the exposure [m].
        measured : Measurement
            Result of the tracker.
        """
        if measured.state is TrackState.ENTRY:
            return
        if measured.tip is not None:
            self._missed = self._agreeing = 0
            self.suspected = False
            return
        turn = (self._missed - _BEFORE) % _PERIOD
        is_due = self._can_check and self._missed >= _BEFORE and turn < _CHECKED
        self._missed += 1
        if self.suspected or not is_due:
            return
        if self._swapped is None:
            self._swapped = NeedleTracker(self._calibration, self._settings)
        if turn == 0:
            self._swapped.reset()
            self._agreeing = 0
        swapped = self._swapped.process(right, left, insertion)
        self._agreeing = self._agreeing + 1 if swapped.tip is not None else 0
        self.suspected = self._agreeing >= _AGREEING


class CameraInfoProblem(NamedTuple):
    """Contradiction between camera_info and calibration, if any; a wrong size rejects all pairs."""

    text: str = ""
    of_size: bool = False


@dataclasses.dataclass(frozen=True)
class Answer:
    """Result of a pair.

    Attributes
    ----------
    pair : Pair of Frame
        The images.
    arrival : float
        Steady time at which the pair was complete [s].
    measured : Measurement
        Result of the tracker.
    refused : str
        Reason for not processing the pair; empty if it was processed.
    """

    pair: Pair[Frame]
    arrival: float
    measured: Measurement
    refused: str


class PairAnswers:
    """Pairs images by stamp, adds the insertion at that stamp, and answers the pairs in order.

    Parameters
    ----------
    calibration : StereoCalibration
        The stereo rig.
    settings : StereoTrackerParameters
        Parameters of the node.

    Attributes
    ----------
    camera_info : dict of str to CameraInfoProblem
        Problem with the last camera_info of each side.
    unanswered : int
        Pairs exposed before the first joint state.
    too_early : int
        Time from the exposure of the last pair to the first joint state [ns]; 0 if it is answered.
    """

    def __init__(self, calibration: StereoCalibration, settings: StereoTrackerParameters) -> None:
        reference = settings.reference(calibration.sizes)
        self.tracker = NeedleTracker(calibration, settings, reference)
        self.tracker.warm_up()
        self.swap = SwapWatch(calibration, settings)
        self.matcher: PairMatcher[Frame] = PairMatcher(settings.pair_tolerance_ns)
        self.insertions = InsertionHistory()
        self.joints_silent = False
        self.unanswered = self.too_early = 0
        self._joint_timeout = settings.joint_timeout
        self._queue: deque[tuple[float, Pair[Frame]]] = deque()
        self._last_stamp: int | None = None
        self.camera_info: dict[str, CameraInfoProblem] = {}

    def add_image(self, side: str, stamp: int, frame: Frame, now: float) -> Iterator[Answer]:
        """Add an image of one side, exposed at `stamp` [ns]; return the answers as `ready`."""
        pair = self.matcher.add(side, stamp, frame)
        if pair is not None:
            self._queue.append((now, pair))
        return self.ready(now)

    def add_insertion(self, stamp: int, insertion: float, now: float) -> Iterator[Answer]:
        """Add an insertion [m] sampled at `stamp` [ns]; return the answers as `ready`."""
        self.joints_silent = False
        self.insertions.add(stamp, insertion)
        return self.ready(now)

    def ready(self, now: float) -> Iterator[Answer]:
        """Yield the answers, in order, to all pairs whose insertion is final.

        Each pair is processed on demand, so that the first answer does not wait for the others.
        """
        while self._queue:
            arrival, pair = self._queue[0]
            self.too_early = 0 if self.joints_silent else self.insertions.time_before(pair.stamp)
            if self.too_early:
                self.unanswered += 1
                self._queue.popleft()
                continue
            if not self.joints_silent and self.insertions.latest < pair.stamp:
                if now - arrival < self._joint_timeout:
                    return
                self.joints_silent = True
            self._queue.popleft()
            refused, insertion = self._refusal(pair), self.insertions.at(pair.stamp)
            left, right = pair.left.pixels, pair.right.pixels
            if refused or left is None or right is None:
                yield Answer(pair, arrival, self.tracker.skip(refused), refused)
                continue
            measured = self.tracker.process(left, right, insertion)
            yield Answer(pair, arrival, measured, refused)
            # The check for swapped images must not delay the answer.
            self.swap.update(left, right, insertion, measured)

    def _refusal(self, pair: Pair[Frame]) -> str:
        """Return the reason for rejecting a pair; a long step back in time resets the tracker."""
        last = self._last_stamp
        if last is None or pair.stamp > last:
            self._last_stamp = pair.stamp
            sizes = (problem.text for problem in self.camera_info.values() if problem.of_size)
            return next(filter(None, (pair.left.problem, pair.right.problem, *sizes)), "")
        back = last - pair.stamp
        if back >= _NEW_RECORDING:
            self.tracker.reset()
            self._last_stamp = pair.stamp
        return "time of exposure ran backwards" if back else "time of exposure repeated"
