"""Shortening of a schedule to the faults that a violation needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from scenario.faults import Fault


def shrink(faults: Sequence[Fault], still: Callable[[list[Fault]], bool]) -> list[Fault]:
    """Drop faults, then shorten those that remain, as long as it still happens.

    Parameters
    ----------
    faults : sequence of Fault
        With which it happens.
    still : callable
        Returns whether it happens with others, too.

    Returns
    -------
    list of Fault
        None of which can be left out alone.
    """
    kept = list(faults)
    smaller = True
    while smaller:
        smaller = False
        for index in range(len(kept)):
            without = kept[:index] + kept[index + 1 :]
            if still(without):
                kept, smaller = without, True
                break
    for index, fault in enumerate(kept):
        shorter = dataclasses.replace(fault, lasts=fault.lasts / 2.0)
        trial = [*kept[:index], shorter, *kept[index + 1 :]]
        if still(trial):
            kept = trial
    return kept
