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
    estimates, torsions : ndarray of ESTIMATE, TORSION, shape (N,), (N, K)
        Present estimates.
    """

    def __init__(self, settings: FilterSettings, count: int, shortest_step: float) -> None:
        self._settings, self._prior = settings, settings.prior()
        # An array: parallel loops cannot take a single record.
        self._assumed = np.array([settings.assumptions()])
        self._needles = np.zeros(count, NEEDLE)
        self._needles["initial_rotation"] = np.eye(3)
        self._needles["has_entry"] = True
        self._hypotheses = np.empty((count, self._prior.size + 1), HYPOTHESIS)
        # A step has two advances if the base begins to turn within it.
        self._events = np.zeros((count, 2 * math.ceil(LAST / shortest_step) + 4), EVENT)
        self.estimates = np.zeros(count, ESTIMATE)
        self.torsions = np.zeros((count, len(settings.torsion_hypotheses)), TORSION)

    def start(self, tips: Array) -> None:
        """Start at first tips, (N, 3) [m]."""
        _start_all(self._needles, self._hypotheses, self._prior, tips, self._assumed)
        self._estimate()

    def advance(self, lengths: Array, turns: Array) -> None:
        """Advance by inserted lengths [m] and rotations of the bases [rad], (N,)."""
        _advance_all(self._needles, self._hypotheses, self._events, lengths, turns, self._assumed)

    def correct(self, tips: Array, covariance: Array | None, ages: Array) -> None:
        """Correct by tips, (N, 3), with their covariance, (3, 3), and ages, (N,)."""
        _correct_all(
            self._needles,
            self._hypotheses,
            self._events,
            self._prior,
            tips,
            self._settings.tip_covariance(covariance),
            ages,
            self._assumed,
        )
        self._estimate()

    def _estimate(self) -> None:
        _estimate_all(self._needles, self._hypotheses, self.estimates, self.torsions, self._assumed)

    def each(self) -> list[Estimate]:
        """Return the estimates as `Estimate`."""
        return [
            estimate_from_record(record, torsions)
            for record, torsions in zip(self.estimates, self.torsions, strict=True)
        ]

    def roll_rates(self, settings: RollLawSettings, bend_sign: float) -> Array:
        """Return each base's rotation rate by the roll law, (N,) [rad/m]."""
        turns = np.empty(self.estimates.size)
        # Contiguous, as in the node: compiled once.
        uncertainty = np.ascontiguousarray(self.estimates["uncertainty"])
        _roll_all(self.estimates, uncertainty, self.torsions, bend_sign, settings, turns)
        return turns / settings.step_length

    def point_rates(
        self, settings: PointLawSettings, targets: Array, rotation_left: Array
    ) -> tuple[Array, Array]:
        """Return rotation rates by the point law, (N,) [rad/m], and insertions left, (N,) [m]."""
        turns, left = np.empty(self.estimates.size), np.empty(self.estimates.size)
        _point_all(self.estimates, self.torsions, targets, rotation_left, settings, turns, left)
        return turns / settings.step_length, left


class ManyObservers:
    """Observers of N needles, and the law of [KC09]."""

    def __init__(
        self, settings: ObserverSettings, law: LinearizingGains | None, count: int
    ) -> None:
        self._settings, self._law = settings, law
        self._needles = np.zeros(count, OBSERVER)

    def start(self, tips: Array) -> Array:
        """Start at first tips, (N, 3) [m], the bases at 0; return the rates, (N,) [rad/m]."""
        self._needles["linearized"][:, 0] = tips[:, 0]
        return self._rates()

    def step(
        self, lengths: Array, unturned: Array, turns: Array, tips: Array, ages: Array
    ) -> Array:
        """Advance by a step, correct by its tips; return the rotation rates, (N,) [rad/m].

        Parameters
        ----------
        lengths, unturned, turns : ndarray, shape (N,)
            Inserted length, its part before the base begins to turn [m], and rotation [rad].
        tips, ages : ndarray, shape (N, 3), (N,)
            See `ManyFilters.correct`.
        """
        _step_observers(self._needles, lengths, unturned, turns, tips, ages, self._settings)
        return self._rates()

    def _rates(self) -> Array:
        rates = np.zeros(self._needles.size)
        if self._law is not None:
            linearized = np.ascontiguousarray(self._needles["linearized"])
            _linearizing_all(linearized, self._settings.curvature, self._law, rates)
        return rates


@compiled
def _start_all(
    needles: Records, hypotheses: Records, prior: Records, tips: Array, assumed: Records
) -> None:
    for n in range(needles.size):
        start_needle(needles[n], hypotheses[n], prior, tips[n], 0.0, 0.0, assumed[0])


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
) -> None:
    for n in prange(needles.size):
        needle, own = needles[n], hypotheses[n]
        correct_needle(needle, own, events[n], prior, tips[n], covariance, ages[n], assumed[0])


@parallel
def _estimate_all(
    needles: Records, hypotheses: Records, estimates: Records, torsions: Records, assumed: Records
) -> None:
    for n in prange(needles.size):
        estimate_needle(needles[n], hypotheses[n], estimates[n], torsions[n], assumed[0])


@compiled
def _roll_all(
    estimates: Records,
    uncertainty: Array,
    torsions: Records,
    bend_sign: float,
    settings: RollLawSettings,
    turns: Array,
) -> None:
    for n in range(estimates.size):
        s, base, wound = estimates[n].linearized, estimates[n].base, estimates[n].wound
        turns[n] = roll_turn(
            s[0], s[1], uncertainty[n], torsions[n], base, wound, bend_sign, settings
        )[0]


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
        estimate = estimates[n]
        turns[n], left[n] = point_turn(
            estimate.coordinates,
            estimate.curvature,
            estimate.uncertainty,
            torsions[n],
            estimate.base,
            estimate.wound,
            targets[n],
            rotation_left[n],
            settings,
        )


@compiled
def _step_observers(
    needles: Records,
    lengths: Array,
    unturned: Array,
    turns: Array,
    tips: Array,
    ages: Array,
    settings: ObserverSettings,
) -> None:
    # Most steps have the same length, and so the same gain.
    since, gain = 0.0, (0.0, 0.0, 0.0)
    for n in range(needles.size):
        needle = needles[n]
        if unturned[n] > 0.0:
            advance_observer(needle, unturned[n], 0.0, settings)
        advance_observer(needle, lengths[n] - unturned[n], turns[n], settings)
        if math.isfinite(tips[n, 0] + tips[n, 1] + tips[n, 2]):
            if needle.since_correction != since:
                since = needle.since_correction
                gain = sampled_observer_gain(settings.poles, since)
            correct_observer(needle, tips[n, 0], ages[n], gain, settings)


@compiled
def _linearizing_all(
    linearized: Array, curvature: float, law: LinearizingGains, rates: Array
) -> None:
    for n in range(rates.size):
        s = linearized[n]
        # Roll of s, the inverse of (6)
        sine = s[2] / curvature
        roll = math.atan2(sine, math.sqrt(1.0 - s[1] * s[1] - sine * sine))
        rates[n] = linearizing_rate(s, roll, curvature, law)[1]
