"""Troubles of a run, with their times; without what every start begins with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from needle_bags.reading.bag_reader import HealthEvent, Result, Run, Status

WARNING = 1


def is_aborted(result: Result) -> bool:
    """Return whether a step or path ended early: not at its end, nor for the next path."""
    return result.outcome.startswith("aborted")


def troubles(run: Run) -> list[HealthEvent]:
    """Return all that went wrong, in order: health, watchdogs that tripped, steps that ended early.

    Parameters
    ----------
    run : Run
        The recorded run.
    """
    aborted = [
        HealthEvent(result.log_time, "device: step", WARNING, result.outcome)
        for result in run.results
        if is_aborted(result)
    ]
    health = [event for event in health_of(run) if event.level]
    return sorted([*health, *trips(run), *aborted], key=lambda event: event.log_time)


def health_of(run: Run) -> list[HealthEvent]:
    """Return the health of parts, without what was over before the first command.

    Nodes that wait for each other at the start are not well until all are there.
    """
    begin = run.first_command
    if begin is None:
        return run.health
    well = {
        event.part: event.log_time
        for event in run.health
        if event.log_time <= begin and not event.level
    }
    return [event for event in run.health if event.log_time > well.get(event.part, -1)]


def trips(run: Run) -> list[HealthEvent]:
    """Return when a watchdog of the controller or the device tripped, and what it then said."""
    return [
        *_trips("plane_controller: watchdog", run.controller_status),
        *_trips("device: watchdog", run.device_status),
    ]


def _trips(part: str, statuses: Sequence[Status]) -> Iterator[HealthEvent]:
    before = None
    for status in statuses:
        text = status.values.get("watchdog_trips", "")
        count = int(text) if text.isdigit() else 0
        if before is not None and count > before:
            why = status.values.get("reason") or "no reason given"
            yield HealthEvent(status.log_time, part, WARNING, why)
        before = count
