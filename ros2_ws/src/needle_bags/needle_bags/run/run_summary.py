"""Summary of a run: distance from the target plane, errors, speed, and events."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_reader import HealthEvent, Result, Run, Series, Stamps, Status
from needle_controller.presets.own_parts import GROUPS
from needle_core.commands.cli import JsonValue, finite_or_none

GOAL = 1e-3
LAST_STRETCH = 20e-3
# Encoder resolution of the reported depth.
DEPTH_TOLERANCE = 1e-6
# Device states without motion; levels of diagnostics.
STOPPED = ("FAULT", "ESTOPPED")
WARNING, ERROR = 1, 2

Floats = npt.NDArray[np.float64]


def summarize(run: Run, wall_s: float | None = None) -> dict[str, JsonValue]:
    """Return the summary of a run, a flat mapping whose keys end in their unit.

    Parameters
    ----------
    run : Run
        The recorded run.
    wall_s : float, optional
        Time from the command to its result [s], measured by the caller.

    Returns
    -------
    dict
        The keys of `scripts/simulate --json`; values are None if the bag lacks the data. r1 is the
        signed true distance of the tip from the target plane, point_error its final distance from
        the target point if there is one.
    """
    r1 = true_r1(run)
    depth = run.insertion_at(run.truth.stamps)
    error = tip_error(run)
    final = float(r1[-1]) if len(r1) else None
    missed = point_error(run)
    target_distance = missed if missed is not None else final
    done = reached_depth(run)
    steps = _steps(run)
    insertion = run.joints.values[:, 0]
    summary: dict[str, JsonValue] = {
        "level": _text(run.run_info.get("level"), run.parameter("sim_rig", "level")),
        "controller": _controller(run),
        "steered_by": steered_by(run),
        "rerun_of": rerun_of(run),
        "seed": _whole(run.run_info.get("seed"), run.parameter("sim_rig", "seed")),
        "steps": steps,
        "converged": target_distance is not None and abs(target_distance) <= GOAL and done,
        "reached_depth": done,
        "r1_initial_mm": _mm(float(r1[0])) if len(r1) else None,
        "r1_final_mm": _mm(final),
        "point_error_mm": _mm(missed),
        "r1_rms_last_20_mm": _mm(_rms_of_last(r1, depth)),
        "tip_error_p95_mm": _mm(_p95(np.linalg.norm(error, axis=1))),
        "depth_error_p95_mm": _mm(_p95(np.abs(error[:, 0]))),
        "insertion_final_mm": _mm(float(insertion.max())) if len(insertion) else None,
        "rotation_total_deg": _rotation_total(run),
        "tips": len(run.tips),
        "tips_not_finite": int(np.sum(~np.isfinite(run.tips.values).all(axis=1))),
        "tips_missed": int(np.sum(~np.isfinite(run.tip_covariances.values).all(axis=1))),
        "steps_aborted": sum(is_aborted(result) for result in run.results),
        "steps_per_s": _steps_per_second(run, steps),
        "wall_s": wall_s,
        "watchdog_trips": watchdog_trips(run),
        "state": run.last_status("state"),
        "reason": run.recording.get("recording_ended") or stop_cause(run),
        "commit": run.commit,
        "bag": str(run.path),
    }
    return {key: finite_or_none(value) for key, value in summary.items()}


def _steps(run: Run) -> int:
    """Return the number of completed steps, or of tips used in a continuous insertion."""
    if run.last_status("insertion") == "continuous":
        return int(run.last_status("step"))
    return sum(result.outcome == "succeeded" for result in run.results)


def rerun_of(run: Run) -> str | None:
    """Return the name of the bag that this one is a rerun of, or None."""
    return _text(run.run_info.get("rerun_of"))


def steered_by(run: Run) -> str | None:
    """Return the controller that steered the needle; in a rerun, that of the original run."""
    return _text(run.run_info.get("steered_by")) if rerun_of(run) else _controller(run)


def target_offset(run: Run) -> float:
    """Return x of the last target plane in `rig` [m]."""
    try:
        return float(run.last_status("target_offset_m"))
    except ValueError:
        configured = run.parameter("plane_controller", "target_offset")
        return float(configured) if isinstance(configured, (int, float)) else 0.0


def target_point(run: Run) -> Floats | None:
    """Return the last target point in `rig` [m], (3,), or None."""
    try:
        point = np.array([float(part) for part in run.last_status("target_point_m").split(",")])
    except ValueError:
        return None
    return point if point.shape == (3,) and np.isfinite(point).all() else None


def point_error(run: Run) -> float | None:
    """Return the final distance of the true tip from the target point [m], or None."""
    point = target_point(run)
    if point is None or not len(run.truth):
        return None
    return float(np.linalg.norm(run.truth.values[-1, :3] - point))


def true_r1(run: Run) -> Floats:
    """Return the true signed distance from the target plane [m], (N,), at `truth.stamps`."""
    return run.truth.values[:, 0] - target_offset(run)


def tip_error(run: Run) -> Floats:
    """Return measured minus true tip in `rig` [m], (N, 3), at common stamps.

    Tips that are not finite are left out; the summary counts them.
    """
    here, there = finite_tips(run).at(run.truth.stamps)
    return finite_tips(run).values[here] - run.truth.values[there, :3]


def finite_tips(run: Run) -> Series:
    """Return the measured tips that are finite."""
    finite = np.isfinite(run.tips.values).all(axis=1)
    return Series(run.tips.stamps[finite], run.tips.values[finite], run.tips.received[finite])


def reduced_states(poses: Series, offset: float = 0.0) -> Floats:
    """Return r = (x - offset [m], beta [rad], gamma [rad]), (N, 3), for poses (N, 7).

    R = Rx(alpha) Ry(beta) Rz(gamma) has the first row (cos b cos g, -cos b sin g, sin b), so
    beta = asin(R13) and gamma = atan2(-R12, R11).
    """
    x, y, z, w = poses.values[:, 3:7].T
    r11 = 1 - 2 * (y * y + z * z)
    r12 = 2 * (x * y - z * w)
    r13 = 2 * (x * z + y * w)
    beta = np.arcsin(np.clip(r13, -1.0, 1.0))
    return np.stack([poses.values[:, 0] - offset, beta, np.arctan2(-r12, r11)], axis=1)


def estimate_error(run: Run, estimate: Series) -> tuple[Stamps, Floats]:
    """Return stamps and estimate minus truth of r = (x [m], beta, gamma [rad]), (N, 3).

    Parameters
    ----------
    run : Run
        The run, with its truth.
    estimate : Series
        Estimated r, (N, 3): `run.reduced_state`, or that of a rerun.
    """
    here, there = estimate.at(run.truth.stamps)
    error = estimate.values[here] - reduced_states(run.truth, target_offset(run))[there]
    error[:, 1:] = (error[:, 1:] + np.pi) % (2.0 * np.pi) - np.pi
    return estimate.stamps[here], error


def commanded_rotation(run: Run) -> Floats:
    """Return each step's insertion [m] and rotation [rad], and the commanded rotation, (N, 3)."""
    if not len(run.joints):
        return np.empty((0, 3))
    return np.column_stack([run.joints_at(run.commands.stamps), run.commands.values[:, 1]])


def reached_depth(run: Run) -> bool:
    """Return whether the needle reached the commanded depth."""
    if any(status.values.get("state") == "DONE" for status in run.controller_status):
        return True
    try:
        commanded = float(run.last_status("depth_m"))
    except ValueError:
        return False
    deepest = float(run.joints.values[:, 0].max(initial=0.0))
    return deepest >= commanded - DEPTH_TOLERANCE


def stop_cause(run: Run) -> str:
    """Return the cause of a stop of the insertion: the first reason reported after steering.

    Later reports, such as that of a disabled device, are consequences.
    """
    if reached_depth(run):
        return run.last_status("reason")
    steered = [s.log_time for s in run.controller_status if s.values.get("state") == "STEERING"]
    causes = [
        (status.log_time, status.values["reason"])
        for status in run.controller_status
        if status.log_time > max(steered, default=0) and status.values.get("reason")
    ]
    begin = run.first_command or 0
    causes += [
        (status.log_time, status.values.get("fault") or status.values.get("reason", ""))
        for status in run.device_status
        if status.log_time > begin and status.values.get("state") in STOPPED
    ]
    causes += [
        (event.log_time, event.message)
        for event in run.health
        if event.log_time > begin and event.part == "sim_rig: simulation" and event.level >= ERROR
    ]
    return min(causes, default=(0, ""))[1]


def watchdog_trips(run: Run) -> int:
    """Return the number of watchdog trips of all nodes."""
    # At level drive, sim_rig publishes no device/status and reports trips in /diagnostics.
    total = sum(event.part == "sim_rig: watchdogs" and event.level > 0 for event in run.health)
    for statuses in (run.controller_status, run.device_status):
        values = [s.values["watchdog_trips"] for s in statuses if "watchdog_trips" in s.values]
        if values and values[-1].isdigit():
            total += int(values[-1])
    return total


def is_aborted(result: Result) -> bool:
    """Return whether a step or path was aborted, rather than completed or replaced."""
    return result.outcome.startswith("aborted")


def troubles(run: Run) -> list[HealthEvent]:
    """Return all warnings, faults, watchdog trips and aborted steps, in order.

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
    """Return the health events, except problems that ended before the first command.

    Nodes warn at the start while they wait for each other.
    """
    begin = run.first_command
    if begin is None:
        return run.health
    recovered = {
        event.part: event.log_time
        for event in run.health
        if event.log_time <= begin and not event.level
    }
    return [event for event in run.health if event.log_time > recovered.get(event.part, -1)]


def trips(run: Run) -> list[HealthEvent]:
    """Return the watchdog trips of controller and device, with the reported reasons."""
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


def _rms_of_last(r1: Floats, depth: Floats) -> float | None:
    if not len(r1) or not np.isfinite(depth).any():
        return None
    last = r1[depth >= np.nanmax(depth) - LAST_STRETCH - DEPTH_TOLERANCE]
    return float(np.sqrt(np.mean(last**2)))


def _rotation_total(run: Run) -> float | None:
    if not len(run.joints):
        return None
    return float(np.degrees(np.abs(np.diff(run.joints.values[:, 1])).sum()))


def _steps_per_second(run: Run, steps: int) -> float | None:
    if not steps or run.first_command is None:
        return None
    elapsed = (run.results[-1].log_time - run.first_command) * 1e-9
    return steps / elapsed if elapsed > 0 else None


def _p95(values: Floats) -> float | None:
    return float(np.percentile(values, 95)) if len(values) else None


def _mm(metres: float | None) -> float | None:
    return None if metres is None else metres * 1e3


def _controller(run: Run) -> str | None:
    preset = _text(run.run_info.get("controller"), run.parameter("plane_controller", "preset"))
    parts = {kind: run.parameter("plane_controller", kind) for kind in GROUPS}
    own = [f"{kind} {name}" for kind, name in parts.items() if name]
    return f"{preset} with {', '.join(own)}" if own else preset


def _text(*candidates: object) -> str | None:
    return next((str(value) for value in candidates if value not in (None, "")), None)


def _whole(*candidates: object) -> int | None:
    return next((value for value in candidates if isinstance(value, int)), None)
