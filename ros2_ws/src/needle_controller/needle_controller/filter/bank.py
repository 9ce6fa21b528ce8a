"""All hypotheses of one needle: what an insertion and a tip do to them; compiled.

Hypotheses that explain the tips badly lose weight and end; those that have become the same become
one. What was inserted since the last tip waits in a queue, so that a late tip is taken at the place
of its exposure. Angles of base and tip count from the start.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.filter.late_tips import FIRST, LAST, untold_age
from needle_controller.filter.merging import copy_hypothesis, merge
from needle_controller.filter.motion import LARGEST_TURN, advance_hypothesis
from needle_controller.filter.records import (
    E_TURN,
    ERROR,
    LONGEST_QUEUE,
)
from needle_controller.filter.tip_update import (
    Reading,
    new_reading,
    new_work,
    read_tip,
    update_hypothesis,
)
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

Records = npt.NDArray[np.void]

MERGE_EVERY = 8
"""Tips from one look for hypotheses that have become the same to the next."""
AGE_TOLERANCE = 1e-9
UNKNOWN_POSITION_STD = 0.02
"""Of a needle that starts without a tip [m]."""
_NEWEST_SHARE = 0.1
_SURVIVORS_PER_JUMP = 4


@compiled
def start_needle(
    needle: Any,
    hypotheses: Records,
    prior: Records,
    tip: Array,
    insertion: float,
    turn: float,
    known: Any,
) -> None:
    """Start at a first tip; `needle` knows entry and initial rotation already.

    Parameters
    ----------
    needle : NEEDLE, changed
        The needle.
    hypotheses : ndarray of HYPOTHESIS, shape (H + 1,), changed
        Room for its hypotheses.
    prior : ndarray of HYPOTHESIS, shape (H,)
        Those of a needle that enters along z with its base at 0.
    tip : ndarray, shape (3,)
        The measured tip [m]; NaN where there is none.
    insertion, turn : float
        Of the base at the same instant [m, rad].
    known : ASSUMPTIONS
        How well all else is known.
    """
    needle.events = needle.pending = 0
    needle.start_insertion, needle.start_turn = insertion, turn
    needle.inserted = needle.late = 0.0
    for k in range(3):
        needle.start[k] = tip[k]
    _start_hypotheses(needle, hypotheses, prior, known)


@compiled
def _start_hypotheses(needle: Any, hypotheses: Records, prior: Records, known: Any) -> None:
    needle.count, needle.tips, needle.too_late = prior.size, 0, False
    needle.base = needle.refused = needle.unexplained = 0.0
    found = math.isfinite(needle.start[0] + needle.start[1] + needle.start[2])
    variance = known.believed_bound**2 / 3.0 if found else UNKNOWN_POSITION_STD**2
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
def advance_needle(
    needle: Any,
    hypotheses: Records,
    events: Records,
    length: float,
    turn: float,
    known: Any,
) -> None:
    """Take what the base did: inserted length [m] and rotation over it [rad]; it waits for a tip.

    Parameters
    ----------
    needle, hypotheses : NEEDLE, ndarray of HYPOTHESIS, changed
        See `start_needle`.
    events : ndarray of EVENT, changed
        Room for what happens in the first centimetres.
    """
    needle.inserted += length
    if needle.events >= 0:
        _keep_event(needle, events, length, turn)
    _queue(needle, hypotheses, length, turn, known)


@compiled
def _keep_event(needle: Any, events: Records, length: float, turn: float) -> None:
    if needle.events == events.size:
        # No room for all of it: tips count as what they say they are.
        needle.events = -1
        return
    event = events[needle.events]
    event.length, event.turn, event.is_tip = length, turn, False
    needle.events += 1


@compiled
def _queue(needle: Any, hypotheses: Records, length: float, turn: float, known: Any) -> None:
    if needle.pending == LONGEST_QUEUE:
        _move(needle, hypotheses, needle.pending_length[0], needle.pending_turn[0], known)
        for k in range(1, needle.pending):
            needle.pending_length[k - 1] = needle.pending_length[k]
            needle.pending_turn[k - 1] = needle.pending_turn[k]
        needle.pending -= 1
    needle.pending_length[needle.pending] = length
    needle.pending_turn[needle.pending] = turn
    needle.pending += 1


@compiled
def _move(needle: Any, hypotheses: Records, length: float, turn: float, known: Any) -> None:
    """Move all hypotheses by what the base did."""
    gain = np.empty((6, 6))
    parts = max(1, math.ceil(max(length / known.longest_step, abs(turn) / LARGEST_TURN) - 1e-9))
    for n in range(needle.count):
        for part in range(parts):
            base = needle.base + part * turn / parts
            advance_hypothesis(hypotheses[n], base, turn / parts, length / parts, known, gain)
    needle.base += turn


@compiled
def _catch_up(needle: Any, hypotheses: Records, age: float, known: Any) -> None:
    """Carry the hypotheses to where a tip was exposed; say whether they are past that already."""
    pending, needle.pending, ahead = needle.pending, 0, -age
    for k in range(pending):
        ahead += needle.pending_length[k]
    needle.too_late = ahead < -AGE_TOLERANCE
    for k in range(pending):
        length, turn = needle.pending_length[k], needle.pending_turn[k]
        take = min(max(ahead, 0.0), length)
        if length > 0.0:
            share = take / length
        else:
            # What only turned belongs to the place it turned at.
            share = 1.0 if ahead > 0.0 or age <= AGE_TOLERANCE else 0.0
        if share > 1.0 - 1e-9:
            share = 1.0
        if share > 0.0:
            _move(needle, hypotheses, share * length, share * turn, known)
        ahead -= take
        if share < 1.0:
            needle.pending_length[needle.pending] = (1.0 - share) * length
            needle.pending_turn[needle.pending] = (1.0 - share) * turn
            needle.pending += 1


@compiled
def looked_ahead(needle: Any, hypotheses: Records, known: Any) -> Records:
    """Return the hypotheses as they will be at the end of the queue; themselves if it is empty."""
    if needle.pending == 0:
        return hypotheses[: needle.count]
    ahead, base = np.empty_like(hypotheses[: needle.count]), needle.base
    for n in range(needle.count):
        copy_hypothesis(hypotheses, n, ahead, n)
    for k in range(needle.pending):
        _move(needle, ahead, needle.pending_length[k], needle.pending_turn[k], known)
    needle.base = base
    return ahead


@compiled
def correct_needle(
    needle: Any,
    hypotheses: Records,
    events: Records,
    prior: Records,
    tip: Array,
    covariance: Array,
    has_covariance: bool,
    age: float,
    known: Any,
) -> None:
    """Take a measured tip.

    Over the first centimetres what happens is kept. If the tips are late then, all of it happens
    once more with tips of that age, and so does all that follows.

    Parameters
    ----------
    needle, hypotheses, events : changed
        See `advance_needle`.
    prior : ndarray of HYPOTHESIS
        See `start_needle`.
    tip : ndarray, shape (3,)
        [m]; NaN where it was not found.
    covariance : ndarray, shape (3, 3)
        Its covariance [m^2], if `has_covariance`; else its noise is bounded as claimed.
    age : float
        Insertion since its exposure, as it says [m].
    """
    reading = new_reading()
    _fill(reading, tip, covariance, has_covariance, known)
    _take(needle, hypotheses, reading, age + needle.late, known)
    if needle.events < 0:
        return
    if needle.events == 0 or events[needle.events - 1].is_tip:
        _keep_event(needle, events, 0.0, 0.0)
        if needle.events < 0:
            return
    event = events[needle.events - 1]
    event.is_tip, event.has_covariance, event.age = True, has_covariance, age
    for i in range(3):
        event.tip[i] = tip[i]
        for j in range(3):
            event.covariance[i, j] = covariance[i, j]
    if needle.inserted < LAST:
        return
    count, needle.events = needle.events, -1
    needle.late = _age_of(needle, events[:count], known)
    if needle.late > 0.0:
        needle.pending = 0
        _start_hypotheses(needle, hypotheses, prior, known)
        for k in range(count):
            event = events[k]
            _queue(needle, hypotheses, event.length, event.turn, known)
            if event.is_tip:
                _fill(reading, event.tip, event.covariance, event.has_covariance, known)
                _take(needle, hypotheses, reading, event.age + needle.late, known)


@compiled
def _age_of(needle: Any, events: Records, known: Any) -> float:
    """Return how late the tips of the first centimetres are [m]; 0 if they are not."""
    inserted, ways, total = np.empty(events.size), np.empty((events.size, 3)), 0.0
    for k in range(events.size):
        event = events[k]
        total += event.length
        inserted[k] = total - event.age
        for i in range(3):
            ways[k, i] = event.tip[i] - needle.start[i] if event.is_tip else math.nan
    too_deep, entry_std = 0.0, math.inf
    if needle.has_entry and needle.start_insertion <= FIRST:
        too_deep, entry_std = -needle.start_insertion, known.entry_std
        for i in range(3):
            too_deep += (needle.start[i] - needle.entry[i]) * needle.initial_rotation[i, 2]
    return untold_age(inserted, ways, too_deep, entry_std, known.believed_bound, known.scale_spread)


@compiled
def _fill(
    reading: Reading, tip: Array, covariance: Array, has_covariance: bool, known: Any
) -> None:
    """Write a tip and its covariance: as claimed, but never less than the model leaves out."""
    for i in range(3):
        reading.tip[i] = tip[i]
        for j in range(3):
            reading.covariance[i, j] = covariance[i, j] if has_covariance else 0.0
        reading.covariance[i, i] += (
            known.model_error if has_covariance else known.believed_bound**2 / 3.0
        )


@compiled
def _take(needle: Any, hypotheses: Records, reading: Reading, age: float, known: Any) -> None:
    """Take a tip of a known age; one that is older than the last is dropped."""
    _catch_up(needle, hypotheses, age, known)
    needle.tips += 1
    if not needle.too_late and read_tip(reading):
        for i in range(3):
            needle.claimed[i] = reading.covariance[i, i]
        work = new_work()
        for n in range(needle.count):
            update_hypothesis(hypotheses[n], reading, known, work)
        _weigh(needle, hypotheses, reading, known)
    if needle.tips % MERGE_EVERY == 0:
        merge(needle, hypotheses, known.merge_angle)


@compiled
def _weigh(needle: Any, hypotheses: Records, reading: Reading, known: Any) -> None:
    """Weigh the hypotheses by their tip; end what is unlikely."""
    # w_n <- w_n p(tip | n), scaled so that the heaviest has 1
    whole = largest = refused = 0.0
    for n in range(needle.count):
        h = hypotheses[n]
        h.weight *= h.evidence
        whole += h.weight
        largest = max(largest, h.weight)
        refused += h.weight * h.outlier
    refused /= whole
    kept = 0
    for n in range(needle.count):
        weight = hypotheses[n].weight / largest
        if weight > known.smallest_weight:
            if kept != n:
                copy_hypothesis(hypotheses, n, hypotheses, kept)
            hypotheses[kept].weight = weight
            kept += 1
    needle.count = kept
    needle.refused = refused
    needle.unexplained += _NEWEST_SHARE * (refused - needle.unexplained)
    _suspect_jumps(needle, hypotheses, reading, known)


@compiled
def _suspect_jumps(needle: Any, hypotheses: Records, reading: Reading, known: Any) -> None:
    """Let hypotheses for which the tip was an outlier come back, displaced to where it was seen.

    The likeliest come first, each with the share of its own weight that a jump has. If the needle
    was not displaced they will end soon; if it was, the next tips will be where they expect them,
    and the others will end.
    """
    survivors = needle.count
    room = min(hypotheses.size - survivors, 1 + survivors // _SURVIVORS_PER_JUMP)
    for _ in range(room):
        likeliest, most = -1, known.smallest_weight
        for n in range(survivors):
            weight = known.jump_share * hypotheses[n].weight * hypotheses[n].outlier
            if weight > most:
                likeliest, most = n, weight
        if likeliest < 0:
            return
        copy_hypothesis(hypotheses, likeliest, hypotheses, needle.count)
        hypotheses[likeliest].outlier = 0.0
        h = hypotheses[needle.count]
        needle.count += 1
        h.weight, h.outlier = most, 0.0
        # Of the place it knows what the tip says, and no more.
        for i in range(3):
            h.position[i], h.residual[i] = reading.tip[i], 0.0
            for j in range(ERROR):
                h.covariance[i, j] = h.covariance[j, i] = reading.covariance[i, j] if j < 3 else 0.0
            h.covariance[E_TURN + i, E_TURN + i] += known.jump_turn_variance
