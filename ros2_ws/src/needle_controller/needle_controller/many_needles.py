"""Filters, observers and laws for studies of many needles: compiled loops over the node's code."""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

import numpy as np
from numba import prange

from needle_controller.filter.bank import advance_needle, correct_needle, start_needle
from needle_controller.filter.filter_settings import FilterSettings
from needle_controller.filter.late_tips import LAST
from needle_controller.filter.mixture import estimate_from_record, estimate_needle
from needle_controller.filter.records import Bank
from needle_controller.laws.law import LinearizingGains, linearizing_rate
from needle_controller.laws.point_law import point_turn
from needle_controller.laws.point_turns import PointLawSettings
from needle_controller.laws.roll_law import RollLawSettings, roll_turn
from needle_controller.model.arrays import Array, Records
from needle_controller.model.gains import sampled_observer_gain
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.luenberger import (
    OBSERVER,
    ObserverSettings,
    advance_observer,
    correct_observer,
)
from needle_core.compiled import compiled, parallel


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
        # A step has two advances if the base begins to turn within it.
        events = 2 * math.ceil(LAST / shortest_step) + 4
        self._settings, self._bank = settings, settings.bank(count, events)
        self.needles, self.estimates = self._bank.needles, self._bank.estimates
        self.torsions = self._bank.torsions
        self.needles["initial_rotation"] = np.eye(3)
        self.needles["has_entry"] = True

    def start(self, tips: Array) -> None:
        """Start at first tips, (N, 3) [m]."""
        for n, tip in enumerate(tips):
            start_needle(self._bank, n, tip, 0.0, 0.0)
            estimate_needle(self._bank, n)

    def advance(self, lengths: Array, turns: Array) -> None:
        """Advance by inserted lengths [m] and rotations of the bases [rad], (N,)."""
        _advance_all(self._bank, lengths, turns)

    def correct(self, tips: Array, covariance: Array | None, ages: Array) -> None:
        """Correct by tips, (N, 3), with their covariance, (3, 3), and ages, (N,)."""
        _correct_all(self._bank, tips, self._settings.tip_covariance(covariance), ages)

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
def _advance_all(bank: Bank, lengths: Array, turns: Array) -> None:
    for k in prange(bank.needles.size):
        # A signed integer, as in the node: compiled once.
        n = np.int64(k)
        advance_needle(bank, n, lengths[n], turns[n])


@parallel
def _correct_all(bank: Bank, tips: Array, covariance: Array, ages: Array) -> None:
    for k in prange(bank.needles.size):
        n = np.int64(k)
        correct_needle(bank, n, tips[n], covariance, ages[n])
        estimate_needle(bank, n)


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
