"""Bank of hypotheses of one needle: prediction by insertion, update by tips; compiled.

Hypotheses that explain the tips badly lose weight and are removed; equal ones are merged. The
insertion since the last tip waits in a queue, so that a late tip is applied at the depth of its
exposure. Angles of base and tip are relative to the start.
"""

# Numba functions take positional arguments: keywords are slow or unsupported.
from __future__ import annotations

import math
from typing import Any

import numpy as np

from needle_controller.filter.heading_update import update_by_heading
from needle_controller.filter.late_tips import FIRST, LAST, hidden_age
from needle_controller.filter.merging import copy_hypothesis, merge, remove_weightless
from needle_controller.filter.motion import LARGEST_TURN, advance_hypothesis
from needle_controller.filter.records import E_TURN, ERROR, LONGEST_QUEUE, Bank
from needle_controller.filter.tip_update import (
    Reading,
    new_reading,
    new_workspace,
    prepare_reading,
    update_hypothesis,
)
from needle_controller.model.arrays import Array, Records
from needle_core.compiled import compiled

MERGE_EVERY = 8
"""Number of tips between two merges of equal hypotheses."""
AGE_TOLERANCE = 1e-9
UNKNOWN_POSITION_STD = 0.02
"""Standard deviation of the position of a needle that starts without a tip [m]."""
_LONGEST_STEP = 0.002
"""Length above which an advance is divided [m]."""
_ENTRY_STD = 0.0005
"""Standard deviation of the tip's position along the needle with the stage at 0 [m]."""
_SMALLEST_WEIGHT = 1.0 / 1000.0
"""Weight relative to the likeliest hypothesis below which a hypothesis is removed."""
_NEWEST_SHARE = 0.1
_SURVIVORS_PER_JUMP = 4
_JUMP_TURN_VARIANCE = math.radians(2.0) ** 2
"""Variance of the rotation in a displacement of phantom or tracker [rad^2]."""


@compiled
def start_needle(bank: Bank, n: int, tip: Array, insertion: float, turn: float) -> None:
    """Start needle n at a first tip; its entry and initial rotation must already be set.

    Parameters
    ----------
    bank, n : Bank, int
        Filters, and the number of the needle.
    tip : ndarray, shape (3,)
        The measured tip [m]; NaN if there is none.
    insertion, turn : float
        Joint positions at the same instant [m], [rad].
    """
    needle = bank.needles[n]
    needle.events = needle.pending = 0
    needle.start_insertion, needle.start_turn = insertion, turn
    needle.inserted = needle.late = 0.0
    for k in range(3):
        needle.start[k] = tip[k]
    _start_hypotheses(needle, bank.hypotheses[n], bank.prior, bank.assumed[0])


@compiled
def _start_hypotheses(needle: Any, hypotheses: Records, prior: Records, assumed: Any) -> None:
    needle.count, needle.tips, needle.tip_too_late = prior.size, 0, False
    needle.base = needle.outlier_probability = needle.mean_outlier_probability = 0.0
    found = math.isfinite(needle.start[0] + needle.start[1] + needle.start[2])
    variance = assumed.effective_bound**2 / 3.0 if found else UNKNOWN_POSITION_STD**2
    for n in range(needle.count):
        copy_hypothesis(prior, n, hypotheses, n)
        h = hypotheses[n]
        # R = R_initial Rz(turn of the base + roll), R_initial Rz(roll) being in the prior.
        c, s = math.cos(needle.start_turn), math.sin(needle.start_turn)
        c, s = (
            c * h.rotation[0, 0] - s * h.rotation[1, 0],
            s * h.rotation[0, 0] + c * h.rotation[1, 0],
        )
        r = needle.initial_rotation
        for i in range(3):
            h.position[i] = needle.start[i] if found else 0.0
            h.rotation[i, 0] = c * r[i, 0] + s * r[i, 1]
            h.rotation[i, 1] = c * r[i, 1] - s * r[i, 0]
            h.rotation[i, 2] = r[i, 2]
        # R_initial diag(a, a, b) R_initial^T = a I + (b - a) z z^T, z the heading
        across, along = h.covariance[E_TURN, E_TURN], h.covariance[E_TURN + 2, E_TURN + 2]
        for i in range(3):
            h.covariance[i, i] = variance
            for j in range(3):
                h.covariance[E_TURN + i, E_TURN + j] = (along - across) * r[i, 2] * r[j, 2]
            h.covariance[E_TURN + i, E_TURN + i] += across


@compiled
def advance_needle(bank: Bank, n: int, length: float, turn: float) -> None:
    """Queue a motion of needle n's base until the next tip: insertion [m] and rotation [rad]."""
    needle = bank.needles[n]
    needle.inserted += length
    if needle.events >= 0:
        _record_event(needle, bank.events[n], length, turn)
    _queue(needle, bank.hypotheses[n], length, turn, bank.assumed[0])


@compiled
def _record_event(needle: Any, events: Records, length: float, turn: float) -> None:
    if needle.events == events.size:
        # The storage is full: do not estimate a hidden age of the tips.
        needle.events = -1
        return
    event = events[needle.events]
    event.length, event.turn, event.is_tip = length, turn, False
    needle.events += 1


@compiled
def _queue(needle: Any, hypotheses: Records, length: float, turn: float, assumed: Any) -> None:
    if needle.pending == LONGEST_QUEUE:
        _advance_all(needle, hypotheses, needle.pending_length[0], needle.pending_turn[0], assumed)
        for k in range(1, needle.pending):
            needle.pending_length[k - 1] = needle.pending_length[k]
            needle.pending_turn[k - 1] = needle.pending_turn[k]
        needle.pending -= 1
    needle.pending_length[needle.pending] = length
    needle.pending_turn[needle.pending] = turn
    needle.pending += 1


@compiled
def _advance_all(
    needle: Any, hypotheses: Records, length: float, turn: float, assumed: Any
) -> None:
    """Advance all hypotheses by a motion of the base."""
    gain = np.empty((6, 6))
    parts = max(1, math.ceil(max(length / _LONGEST_STEP, abs(turn) / LARGEST_TURN) - 1e-9))
    for n in range(needle.count):
        for part in range(parts):
            base = needle.base + part * turn / parts
            advance_hypothesis(hypotheses[n], base, turn / parts, length / parts, assumed, gain)
    needle.base += turn


@compiled
def _advance_to_exposure(needle: Any, hypotheses: Records, age: float, assumed: Any) -> None:
    """Advance the hypotheses to a tip's exposure; record whether they are already beyond it."""
    pending, needle.pending, ahead = needle.pending, 0, -age
    for k in range(pending):
        ahead += needle.pending_length[k]
    needle.tip_too_late = ahead < -AGE_TOLERANCE
    for k in range(pending):
        length, turn = needle.pending_length[k], needle.pending_turn[k]
        take = min(max(ahead, 0.0), length)
        if length > 0.0:
            share = take / length
        else:
            # A rotation without insertion belongs to the depth at which it happened.
            share = 1.0 if ahead > 0.0 or age <= AGE_TOLERANCE else 0.0
        if share > 1.0 - 1e-9:
            share = 1.0
        if share > 0.0:
            _advance_all(needle, hypotheses, share * length, share * turn, assumed)
        ahead -= take
        if share < 1.0:
            needle.pending_length[needle.pending] = (1.0 - share) * length
            needle.pending_turn[needle.pending] = (1.0 - share) * turn
            needle.pending += 1


@compiled
def predicted_hypotheses(needle: Any, hypotheses: Records, assumed: Any) -> Records:
    """Return the hypotheses predicted to the end of the queue; unchanged if it is empty."""
    if needle.pending == 0:
        return hypotheses[: needle.count]
    ahead, base = np.empty_like(hypotheses[: needle.count]), needle.base
    for n in range(needle.count):
        copy_hypothesis(hypotheses, n, ahead, n)
    for k in range(needle.pending):
        _advance_all(needle, ahead, needle.pending_length[k], needle.pending_turn[k], assumed)
    needle.base = base
    return ahead


@compiled
def correct_needle(bank: Bank, n: int, tip: Array, covariance: Array, age: float) -> None:
    """Apply a measured tip of needle n.

    The events of the first centimetres are recorded. If they show that the tips are late, they are
    replayed with that age, which is assumed for later tips, too.

    Parameters
    ----------
    bank, n : Bank, int
        See `start_needle`.
    tip : ndarray, shape (3,)
        The tip [m]; NaN if it was not found.
    covariance : ndarray, shape (3, 3)
        Covariance of the tip, see `FilterSettings.tip_covariance` [m^2].
    age : float
        Stated insertion since the exposure of the tip [m].
    """
    needle, hypotheses, events = bank.needles[n], bank.hypotheses[n], bank.events[n]
    assumed, heading = bank.assumed[0], needle.heading.copy()
    needle.heading[3] = 0.0
    reading = new_reading(tip, covariance, heading)
    _apply_tip(needle, hypotheses, reading, age + needle.late, assumed)
    if needle.events < 0:
        return
    if needle.events == 0 or events[needle.events - 1].is_tip:
        _record_event(needle, events, 0.0, 0.0)
        if needle.events < 0:
            return
    event = events[needle.events - 1]
    event.is_tip, event.age = True, age
    for i in range(3):
        event.tip[i] = tip[i]
        for j in range(3):
            event.covariance[i, j] = covariance[i, j]
    for i in range(4):
        event.heading[i] = heading[i]
    if needle.inserted < LAST:
        return
    count, needle.events = needle.events, -1
    needle.late = _estimated_age(needle, events[:count], assumed)
    if needle.late > 0.0:
        needle.pending = 0
        _start_hypotheses(needle, hypotheses, bank.prior, assumed)
        for k in range(count):
            event = events[k]
            _queue(needle, hypotheses, event.length, event.turn, assumed)
            if event.is_tip:
                reading = new_reading(event.tip, event.covariance, event.heading)
                _apply_tip(needle, hypotheses, reading, event.age + needle.late, assumed)


@compiled
def _estimated_age(needle: Any, events: Records, assumed: Any) -> float:
    """Return the hidden age of the tips of the first centimetres [m]; 0 if they are not late."""
    inserted, shifts, total = np.empty(events.size), np.empty((events.size, 3)), 0.0
    for k in range(events.size):
        event = events[k]
        total += event.length
        inserted[k] = total - event.age
        for i in range(3):
            shifts[k, i] = event.tip[i] - needle.start[i] if event.is_tip else math.nan
    too_deep, entry_std = 0.0, math.inf
    if needle.has_entry and needle.start_insertion <= FIRST:
        too_deep, entry_std = -needle.start_insertion, _ENTRY_STD
        for i in range(3):
            too_deep += (needle.start[i] - needle.entry[i]) * needle.initial_rotation[i, 2]
    return hidden_age(inserted, shifts, too_deep, entry_std, assumed.effective_bound)


@compiled
def _apply_tip(
    needle: Any, hypotheses: Records, reading: Reading, age: float, assumed: Any
) -> None:
    """Update by a tip of a known age, unless it is older than the last one."""
    _advance_to_exposure(needle, hypotheses, age, assumed)
    needle.tips += 1
    if not needle.tip_too_late and prepare_reading(reading):
        for i in range(3):
            needle.claimed[i] = reading.covariance[i, i]
        work = new_workspace()
        for n in range(needle.count):
            likelihood = 1.0
            if reading.heading[3] > 0.0:
                likelihood = update_by_heading(hypotheses[n], reading.heading, assumed, work)
            update_hypothesis(hypotheses[n], reading, assumed, work)
            hypotheses[n].evidence *= likelihood
        _reweight(needle, hypotheses, reading, assumed)
    if needle.tips % MERGE_EVERY == 0:
        merge(needle, hypotheses)


@compiled
def _reweight(needle: Any, hypotheses: Records, reading: Reading, assumed: Any) -> None:
    """Reweight the hypotheses by their evidence; remove unlikely ones."""
    # w_n <- w_n p(tip | n), scaled so that the heaviest has 1
    whole = largest = outlier = 0.0
    for n in range(needle.count):
        h = hypotheses[n]
        h.weight *= h.evidence
        whole += h.weight
        largest = max(largest, h.weight)
        outlier += h.weight * h.outlier
    outlier /= whole
    for n in range(needle.count):
        weight = hypotheses[n].weight / largest
        hypotheses[n].weight = weight if weight > _SMALLEST_WEIGHT else 0.0
    remove_weightless(needle, hypotheses)
    needle.outlier_probability = outlier
    needle.mean_outlier_probability += _NEWEST_SHARE * (outlier - needle.mean_outlier_probability)
    _add_jump_hypotheses(needle, hypotheses, reading, assumed)


@compiled
def _add_jump_hypotheses(needle: Any, hypotheses: Records, reading: Reading, assumed: Any) -> None:
    """Add copies of hypotheses for which the tip was an outlier, displaced to the tip.

    The likeliest come first, each with the weight of its jump. If the needle was not displaced,
    they are soon removed; if it was, the next tips confirm them, and the others are removed.
    """
    survivors = needle.count
    room = min(hypotheses.size - survivors, 1 + survivors // _SURVIVORS_PER_JUMP)
    for _ in range(room):
        likeliest, most = survivors, _SMALLEST_WEIGHT
        for n in range(survivors):
            weight = assumed.jump_share * hypotheses[n].weight * hypotheses[n].outlier
            if weight > most:
                likeliest, most = n, weight
        if likeliest == survivors:
            return
        copy_hypothesis(hypotheses, likeliest, hypotheses, needle.count)
        hypotheses[likeliest].outlier = 0.0
        h = hypotheses[needle.count]
        needle.count += 1
        h.weight, h.outlier = most, 0.0
        # Its position and covariance are those of the tip.
        for i in range(3):
            h.position[i], h.residual[i] = reading.tip[i], 0.0
            for j in range(ERROR):
                h.covariance[i, j] = h.covariance[j, i] = reading.covariance[i, j] if j < 3 else 0.0
            h.covariance[E_TURN + i, E_TURN + i] += _JUMP_TURN_VARIANCE
