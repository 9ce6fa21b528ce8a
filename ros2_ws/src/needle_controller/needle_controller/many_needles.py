"""Filters, observers and laws for studies of many needles: compiled loops over the node's code."""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from needle_controller.filter.bank import advance_needle, correct_needle, start_needle
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.late_tips import LAST
from needle_controller.filter.mixture import estimate_from_record, estimate_needle
from needle_controller.filter.records import ESTIMATE, EVENT, HYPOTHESIS, NEEDLE, TORSION
from needle_controller.laws.law import LinearizingGains, linearizing_rate
from needle_controller.laws.point_law import point_turn
from needle_controller.laws.point_turns import PointLawSettings
from needle_controller.laws.roll_law import RollLawSettings, roll_turn
from needle_controller.model.arrays import Array
from needle_controller.model.gains import sampled_observer_gain
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.luenberger import (
    OBSERVER,
    ObserverSettings,
    advance_observer,
    correct_observer,
)
from needle_core.compiled import compiled, parallel

Records = npt.NDArray[np.void]


class ManyFilters:
    """Hypothesis filters of N needles, equivalent to N instances of `HypothesisFilter`.

    The needles enter at the origin along z, with their bases at 0.

    Parameters
    ----------
    settings : FilterSettings
        Assumptions.
    count : int
        Number of needles N.
    shortest_step : float
        Least insertion between two tips [m].

    Attributes
    ----------
    needles : ndarray of NEEDLE, shape (N,)
        Their states.
    estimates, torsions : ndarray of ESTIMATE, TORSION, shape (N,), (N, K)
        Present estimates.
    """

    def __init__(self, settings: FilterSettings, count: int, shortest_step: float) -> None:
        self._settings, self._prior = settings, settings.prior()
        # An array: parallel loops cannot take a single record.
        self._assumed = np.array([settings.assumptions()])
        self.needles = np.zeros(count, NEEDLE)
        self.needles["initial_rotation"] = np.eye(3)
        self.needles["has_entry"] = True
        self._hypotheses = np.empty((count, self._prior.size + 1), HYPOTHESIS)
        # A step has two advances if the base begins to turn within it.
        self._events = np.zeros((count, 2 * math.ceil(LAST / shortest_step) + 4), EVENT)
        self.estimates = np.zeros(count, ESTIMATE)
        self.torsions = np.zeros((count, len(settings.torsion_hypotheses)), TORSION)

    def start(self, tips: Array) -> None:
        """Start at first tips, (N, 3) [m]."""
        for needle, own, tip in zip(self.needles, self._hypotheses, tips, strict=True):
            start_needle(needle, own, self._prior, tip, 0.0, 0.0, self._assumed[0])
        every = zip(self.needles, self._hypotheses, self.estimates, self.torsions, strict=True)
        for records in every:
            estimate_needle(*records, self._assumed[0])

    def advance(self, lengths: Array, turns: Array) -> None:
        """Advance by inserted lengths [m] and rotations of the bases [rad], (N,)."""
        _advance_all(self.needles, self._hypotheses, self._events, lengths, turns, self._assumed)

    def correct(self, tips: Array, covariance: Array | None, ages: Array) -> None:
        """Correct by tips, (N, 3), with their covariance, (3, 3), and ages, (N,)."""
        _correct_all(
            self.needles,
            self._hypotheses,
            self._events,
            self._prior,
            tips,
            self._settings.tip_covariance(covariance),
            ages,
            self._assumed,
            self.estimates,
            self.torsions,
        )

    def each(self) -> list[Estimate]:
        """Return the estimates as `Estimate`."""
        return [
            estimate_from_record(record, torsions)
            for record, torsions in zip(self.estimates, self.torsions, strict=True)
        ]

    def roll_rates(self, settings: RollLawSettings, bend_sign: float) -> Array:
        """Return each base's rotation rate by the roll law, (N,) [rad/m]."""
        turns = np.empty(self.estimates.size)
        _roll_all(self.estimates, self.torsions, bend_sign, settings, turns)
        return turns / settings.step_length

    def point_rates(
        self, settings: PointLawSettings, targets: Array, rotation_left: Array
    ) -> tuple[Array, Array]:
        """Return rotation rates by the point law, (N,) [rad/m], and insertions left, (N,) [m]."""
        turns, left = np.empty(self.estimates.size), np.empty(self.estimates.size)
        _point_all(self.estimates, self.torsions, targets, rotation_left, settings, turns, left)
        return turns / settings.step_length, left


class ManyObservers:
    """Observers of N needles, whose bases start at 0, and the law of [KC09]."""

    def __init__(self, settings: ObserverSettings, count: int) -> None:
        self._settings = settings
        self._needles = np.zeros(count, OBSERVER)

    def start(self, tips: Array) -> None:
        """Start at first tips, (N, 3) [m]."""
        self._needles["linearized"][:, 0] = tips[:, 0]

    def advance(self, lengths: Array, turns: Array) -> None:
        """Advance by inserted lengths [m] and rotations of the bases [rad], (N,)."""
        _advance_observers(self._needles, lengths, turns, self._settings)

    def correct(self, tips: Array, _covariance: Array | None, ages: Array) -> None:
        """Correct by tips, (N, 3), of ages (N,); the constant gain does not use a covariance."""
        _correct_observers(self._needles, tips, ages, self._settings)

    def rates(self, law: LinearizingGains | None) -> Array:
        """Return each base's rotation rate by the law of [KC09], (N,) [rad/m]; without one, 0."""
        rates = np.zeros(self._needles.size)
        if law is not None:
            _linearizing_all(self._needles, self._settings.curvature, law, rates)
        return rates


@parallel
def _advance_all(
    needles: Records,
    hypotheses: Records,
    events: Records,
    lengths: Array,
    turns: Array,
    assumed: Records,
) -> None:
    for n in prange(needles.size):
        advance_needle(needles[n], hypotheses[n], events[n], lengths[n], turns[n], assumed[0])


@parallel
def _correct_all(
    needles: Records,
    hypotheses: Records,
    events: Records,
    prior: Records,
    tips: Array,
    covariance: Array,
    ages: Array,
    assumed: Records,
    estimates: Records,
    torsions: Records,
) -> None:
    for n in prange(needles.size):
        needle, own = needles[n], hypotheses[n]
        correct_needle(needle, own, events[n], prior, tips[n], covariance, ages[n], assumed[0])
        estimate_needle(needle, own, estimates[n], torsions[n], assumed[0])


@compiled
def _roll_all(
    estimates: Records,
    torsions: Records,
    bend_sign: float,
    settings: RollLawSettings,
    turns: Array,
) -> None:
    for n in range(estimates.size):
        turns[n] = roll_turn(estimates[n], torsions[n], bend_sign, settings)[0]


@compiled
def _point_all(
    estimates: Records,
    torsions: Records,
    targets: Array,
    rotation_left: Array,
    settings: PointLawSettings,
    turns: Array,
    left: Array,
) -> None:
    for n in range(estimates.size):
        turns[n], left[n] = point_turn(
            estimates[n], torsions[n], targets[n], rotation_left[n], settings
        )


@compiled
def _advance_observers(
    needles: Records, lengths: Array, turns: Array, settings: ObserverSettings
) -> None:
    for n in range(needles.size):
        advance_observer(needles[n], lengths[n], turns[n], settings)


@compiled
def _correct_observers(
    needles: Records, tips: Array, ages: Array, settings: ObserverSettings
) -> None:
    # Most steps have the same length, and so the same gain.
    since, gain = 0.0, (0.0, 0.0, 0.0)
    for n in range(needles.size):
        needle = needles[n]
        if math.isfinite(tips[n, 0] + tips[n, 1] + tips[n, 2]):
            if needle.since_correction != since:
                since = needle.since_correction
                gain = sampled_observer_gain(settings.poles, since)
            correct_observer(needle, tips[n, 0], ages[n], gain, settings)


@compiled
def _linearizing_all(
    needles: Records, curvature: float, law: LinearizingGains, rates: Array
) -> None:
    for n in range(rates.size):
        s = needles[n].linearized
        # Roll of s, the inverse of (6)
        sine = s[2] / curvature
        roll = math.atan2(sine, math.sqrt(1.0 - s[1] * s[1] - sine * sine))
        rates[n] = linearizing_rate(s, roll, curvature, law)[1]
