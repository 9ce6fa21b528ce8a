"""Health of the tracker node: counters in, diagnostics out."""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from typing import Any

from needle_core.diagnostics import Diagnostic, Level
from needle_tracker.answers.pair_answers import SUSPICION, PairAnswers
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.sources.pairing import OTHER_SIDE, PairMatcher

WARNING_DURATION = 5.0  # duration of a warning after its cause [s]
CLOCKS_DIFFER = 1_000_000_000  # lead of a pair over the first joint state that is a fault [ns]
PARTNER_LATE = 0.5  # delay before an image without a partner is reported [s]
_RATE_WINDOW = 5.0  # [s]
_NOTHING_YET = Measurement(None, TrackState.SEARCHING, "no images yet")
_EXCHANGE = "exchange stereo_camera's parameters left and right, or the cables"


@dataclasses.dataclass
class Health:
    """Counters of the node; times are steady times, passed as arguments [s].

    Attributes
    ----------
    refused : Counter of str
        Pairs that were not processed, by reason.
    rejected : Counter of str
        Pairs without a tip, by reason.
    """

    refused: Counter[str] = dataclasses.field(default_factory=Counter)
    rejected: Counter[str] = dataclasses.field(default_factory=Counter)
    joints_without_insertion: int = 0
    last_refusal: tuple[float, str] | None = None
    _last_image: dict[str, float] = dataclasses.field(default_factory=dict)
    _first_image: float = 0.0
    _last_unpaired: float | None = None
    _unpaired: int = 0
    _done: deque[tuple[float, float]] = dataclasses.field(
        default_factory=lambda: deque(maxlen=1000)
    )
    _tips: int = 0
    _measured: Measurement = _NOTHING_YET

    def add_image(self, side: str, now: float) -> None:
        """Count an image of one side."""
        if not self._last_image:
            self._first_image = now
        self._last_image[side] = now

    def add_refused(self, reason: str, now: float) -> None:
        """Count a pair that was not processed."""
        self.refused[reason] += 1
        self.last_refusal = (now, reason)

    def add_pair(self, arrival: float, now: float, measured: Measurement) -> None:
        """Count a pair, complete at `arrival` and answered at `now`."""
        self._done.append((now, now - arrival))
        self._measured = measured
        if measured.tip is None:
            self.rejected[measured.reason] += 1
        else:
            self._tips += 1

    def update_unpaired(self, now: float, matcher: PairMatcher[Any]) -> None:
        """Record whether images were dropped without a partner since the last call."""
        if matcher.unpaired.total() > self._unpaired:
            self._unpaired, self._last_unpaired = matcher.unpaired.total(), now

    def track(self) -> Diagnostic:
        """Return the health of the track."""
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
        values.update({f"no tip: {reason}": str(n) for reason, n in self.rejected.items()})
        message = state.value + (f": {reason}" if reason else "")
        return Diagnostic(Level.OK if good else Level.WARN, message, values)

    def images(self, now: float, answers: PairAnswers) -> Diagnostic:
        """Return the health of the images and their pairing."""
        matcher = answers.matcher
        recent = [(at, took) for at, took in self._done if now - at <= _RATE_WINDOW]
        latencies = sorted(took for _, took in recent)
        values = {
            "pairs": str(matcher.pairs),
            "rate_hz": f"{len(recent) / _RATE_WINDOW:.1f}",
            "latency_median_ms": f"{1e3 * latencies[len(latencies) // 2]:.1f}" if recent else "",
            "latency_max_ms": f"{1e3 * latencies[-1]:.1f}" if recent else "",
            "left_without_right": str(matcher.unpaired["left"]),
            "right_without_left": str(matcher.unpaired["right"]),
            "pairs_refused": str(self.refused.total()),
            "pair_tolerance_ms": f"{1e-6 * matcher.tolerance:.2f}",
        }
        if matcher.skew is not None:
            skews = zip(("skew_median_ms", "skew_max_ms"), matcher.skew, strict=True)
            values.update({name: f"{1e-6 * skew:.2f}" for name, skew in skews})
        values.update({f"refused: {reason}": str(n) for reason, n in self.refused.items()})
        return Diagnostic(*self._images_level(now, answers), values)

    def joints(self, answers: PairAnswers) -> Diagnostic:
        """Return the health of the joint states."""
        history = answers.insertions
        values = {
            "without_insertion_joint": str(self.joints_without_insertion),
            "not_finite": str(history.rejected),
            "time_ran_backwards": str(history.restarts),
            "pairs_before_joint_states": str(answers.unanswered),
        }
        level, message = Level.OK, "insertion known" if len(history) else "no joint states yet"
        if answers.too_early > CLOCKS_DIFFER:
            early = f"exposed {1e-9 * answers.too_early:.1f} s before the first joint state"
            level, message = Level.WARN, f"no pair is processed: {early}"
        elif answers.joints_silent:
            level, message = Level.WARN, "no joint state follows the images: insertion unknown"
        return Diagnostic(level, message, values)

    def _images_level(self, now: float, answers: PairAnswers) -> tuple[Level, str]:
        if self.last_refusal is not None and now - self.last_refusal[0] <= WARNING_DURATION:
            return Level.ERROR, f"pair refused: {self.last_refusal[1]}"
        for problem in answers.camera_info.values():
            if problem.text:
                return Level.ERROR, problem.text
        if answers.swap.suspected:
            return Level.WARN, f"{SUSPICION}; {_EXCHANGE}"
        return self._pairing_level(now, answers.matcher)

    def _pairing_level(self, now: float, matcher: PairMatcher[Any]) -> tuple[Level, str]:
        for side, other in OTHER_SIDE.items():
            last = self._last_image.get(other, self._first_image)
            if matcher.waiting(side) and now - last > PARTNER_LATE:
                return Level.WARN, f"{side} images without {other}"
        if self._last_unpaired is not None and now - self._last_unpaired <= WARNING_DURATION:
            return Level.WARN, "images without a partner were dropped"
        if not self._last_image:
            return Level.WARN, "no images yet"
        return Level.OK, "pairs complete"
