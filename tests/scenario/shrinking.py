"""Shortening of a schedule to the faults that a violation needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from scenario.faults import Fault


def shrink(faults: Sequence[Fault], still: Callable[[list[Fault]], bool]) -> list[Fault]:
    """Drop faults, then shorten the others, as long as the violation still occurs.

    Parameters
    ----------
    faults : sequence of Fault
        Faults that cause the violation.
    still : callable
        Returns whether other faults cause it, too.

    Returns
    -------
    list of Fault
        Faults, none of which can be dropped alone.
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
