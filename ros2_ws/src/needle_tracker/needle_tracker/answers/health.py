"""Health of the tracker node: counters in, diagnostics out."""

from __future__ import annotations

import math
from collections import Counter, deque

from needle_core.diagnostics import Diagnostic, Level
from needle_tracker.answers.pair_answers import SUSPICION, Answer, PairAnswers
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.sources.pairing import OTHER_SIDE

_DURATION = 5.0  # duration of a warning after its cause [s]
_CLOCKS_DIFFER = 1_000_000_000  # a pair this far ahead of the first joint state is a fault [ns]
_PARTNER_LATE = 0.5  # delay before an image without a partner is reported [s]
_RATE_WINDOW = 5.0  # [s]
_EXCHANGE = "exchange stereo_camera's parameters left and right, or the cables"


class Health:
    """Counters of the node; times are steady times, passed as arguments [s].

    Parameters
    ----------
    answers : PairAnswers
        Core of the node.

    Attributes
    ----------
    joints_without_insertion : int
        Number of joint states without an insertion.
    """

    def __init__(self, answers: PairAnswers) -> None:
        self._answers = answers
        self.joints_without_insertion = 0
        # Pairs that were not processed, and pairs without a tip, by reason.
        self._refused, self._rejected = Counter[str](), Counter[str]()
        self._refusal, self._refused_at = "", -math.inf
        self._unpaired, self._unpaired_at = 0, -math.inf
        self._image_at: dict[str, float] = {}
        self._done: deque[tuple[float, float]] = deque(maxlen=1000)
        self._tips = 0
        self._measured = Measurement(None, TrackState.SEARCHING, "no images yet")

    def add_image(self, side: str, now: float) -> None:
        """Count an image of one side."""
        self._image_at = {**dict.fromkeys(OTHER_SIDE, now), **self._image_at, side: now}

    def add_pair(self, answer: Answer, now: float) -> None:
        """Count a pair that was answered at `now`."""
        self._done.append((now, now - answer.arrival))
        self._measured = answer.measured
        if answer.refused:
            self._refused[answer.refused] += 1
            self._refusal, self._refused_at = answer.refused, now
        if answer.measured.tip is None:
            self._rejected[answer.measured.reason] += 1
        else:
            self._tips += 1

    def parts(self, now: float) -> dict[str, Diagnostic]:
        """Return the health of the track, of the images and of the joint states."""
        return {"track": self._track(), "images": self._images(now), "joints": self._joints()}

    def _track(self) -> Diagnostic:
        measured, (zero, scale) = self._measured, self._measured.stage
        state, reason = measured.state, measured.reason
        good = state in (TrackState.TRACKING, TrackState.ENTRY) and not reason
        values = {
            "state": state.value,
            "reason": str(reason),
            "tips": str(self._tips),
            "probability": f"{measured.probability:.3f}",
            "stage zero [mm]": f"{1e3 * zero:.2f}",
            "stage scale error [%]": f"{100 * scale:.2f}",
        }
        values.update({f"no tip: {reason}": str(n) for reason, n in self._rejected.items()})
        message = state.value + (f": {reason}" if reason else "")
        return Diagnostic(Level.OK if good else Level.WARN, message, values)

    def _images(self, now: float) -> Diagnostic:
        matcher = self._answers.matcher
        if matcher.unpaired.total() > self._unpaired:
            self._unpaired, self._unpaired_at = matcher.unpaired.total(), now
        recent = [(at, took) for at, took in self._done if now - at <= _RATE_WINDOW]
        latencies = sorted(took for _, took in recent)
        values = {
            "pairs": str(matcher.pairs),
            "rate_hz": f"{len(recent) / _RATE_WINDOW:.1f}",
            "latency_median_ms": f"{1e3 * latencies[len(latencies) // 2]:.1f}" if recent else "",
            "latency_max_ms": f"{1e3 * latencies[-1]:.1f}" if recent else "",
            "left_without_right": str(matcher.unpaired["left"]),
            "right_without_left": str(matcher.unpaired["right"]),
            "pairs_refused": str(self._refused.total()),
            "pair_tolerance_ms": f"{1e-6 * matcher.tolerance:.2f}",
        }
        if matcher.skew is not None:
            skews = zip(("skew_median_ms", "skew_max_ms"), matcher.skew, strict=True)
            values.update({name: f"{1e-6 * skew:.2f}" for name, skew in skews})
        values.update({f"refused: {reason}": str(n) for reason, n in self._refused.items()})
        return Diagnostic(*self._images_level(now), values)

    def _joints(self) -> Diagnostic:
        answers, history = self._answers, self._answers.insertions
        values = {
            "without_insertion_joint": str(self.joints_without_insertion),
            "not_finite": str(history.rejected),
            "time_ran_backwards": str(history.restarts),
            "pairs_before_joint_states": str(answers.unanswered),
        }
        level, message = Level.OK, "insertion known" if len(history) else "no joint states yet"
        if answers.too_early > _CLOCKS_DIFFER:
            early = f"exposed {1e-9 * answers.too_early:.1f} s before the first joint state"
            level, message = Level.WARN, f"no pair is processed: {early}"
        elif answers.joints_silent:
            level, message = Level.WARN, "no joint state follows the images: insertion unknown"
        return Diagnostic(level, message, values)

    def _images_level(self, now: float) -> tuple[Level, str]:
        """Return the first of the states of the images that holds."""
        answers, waiting = self._answers, self._answers.matcher.waiting
        late = {side for side, at in self._image_at.items() if now - at > _PARTNER_LATE}
        refused, dropped = (now - at <= _DURATION for at in (self._refused_at, self._unpaired_at))
        states = (
            (Level.ERROR, f"pair refused: {self._refusal}", refused),
            *((Level.ERROR, info.text, info.text) for info in answers.camera_info.values()),
            (Level.WARN, f"{SUSPICION}; {_EXCHANGE}", answers.swap.suspected),
            *(
                (Level.WARN, f"{side} images without {other}", waiting(side) and other in late)
                for side, other in OTHER_SIDE.items()
            ),
            (Level.WARN, "images without a partner were dropped", dropped),
            (Level.WARN, "no images yet", not self._image_at),
            (Level.OK, "pairs complete", True),
        )
        return next((level, message) for level, message, holds in states if holds)
