"""Speed and memory of studies and of the node's update, compared with the reference loops."""

from __future__ import annotations

import dataclasses
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from campaign.benchmarks import reference_loop
from campaign.benchmarks.figure_rows import Row
from needle_bringup.studies.study_controllers import controller_factory, needles_at_a_time
from needle_controller.model.gains import sampled_observer_gain
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import NOISE, Disturbances, uniform_numbers
from needle_sim.studies.needles import NeedleBatch
from needle_sim.studies.study import GRIDS, StartBounds, StudySettings, run_study

TIP_NOISE = 0.001
STEPS = 120
NEEDLES = 10_000
PLAIN_NEEDLES = 40
CONTROL_NEEDLES = 3
ALONE_NEEDLES = 20
UPDATES = 2_000
SETTINGS = SteeringSettings(**PAPER_NOISE)
STARTS = GRIDS["endpoint"](StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0)), 10, 1)
STUDY = StudySettings(
    SETTINGS.curvature, 0.120, SETTINGS.step_length, Disturbances(TIP_NOISE), seed=1
)


def design() -> reference_loop.Design:
    """Return the paper preset's gains for the reference loops."""
    gains = SETTINGS.gains()
    observer = np.array(sampled_observer_gain(gains.observer_poles, SETTINGS.step_length))
    return reference_loop.Design(
        SETTINGS.curvature,
        SETTINGS.step_length,
        tuple(gains.feedback.tolist()),
        tuple(observer.tolist()),
        SETTINGS.saturation_margin,
        SETTINGS.demand_margin,
        SETTINGS.max_rotation_per_length,
    )


def studies() -> Iterator[Row]:
    """Yield the time of a study with 10,000 needles x 120 steps."""
    plain, with_control = _plain_study(), _control_study()
    for name, times in (("paper", 5), ("best", 1)):
        factory = controller_factory(name, TIP_NOISE)
        run_study(STARTS[:2], factory, STUDY)  # compiles
        chunk = needles_at_a_time(name)
        seconds = _least_time(partial(run_study, STARTS, factory, STUDY, chunk=chunk), times)
        for against, reference in (
            ("paper in plain Python", plain),
            ("paper in python-control", with_control),
            (f"{name}, one needle at a time", _study_one_by_one(name)),
        ):
            what = f"{name}, {NEEDLES:,} x {STEPS} steps"
            yield Row(f"study_{name}", what, "s", seconds, against, reference)


def updates() -> Iterator[Row]:
    """Yield the time of one update of the node: estimate with covariance, command, reachability."""
    d = design()
    s, errors = (-0.003, 0.0, 0.0), uniform_numbers(1, 1, 0, 0, UPDATES)[:, 0] * TIP_NOISE
    plain = _least_time(
        lambda: [
            reference_loop.law_turn(reference_loop.observer_step(s, d, 0.1, error), d)
            for error in errors.tolist()
        ],
        3,
    )
    with_control = _control_study() / NEEDLES / STEPS * 1e6
    for name in ("paper", "best"):
        taken = _tips_of_a_run(name)
        seconds = _least_time(partial(_update_all, name, taken), 5) / len(taken) * 1e6
        for against, reference in (
            ("paper in plain Python", plain / UPDATES * 1e6),
            ("paper in python-control", with_control),
        ):
            what = f"{name}, one update of the node's"
            yield Row(f"update_{name}", what, "us", seconds, against, reference)


def memory() -> Iterator[Row]:
    """Yield the peak memory of a study, which must not grow with the number of steps."""
    for name in ("paper", "best"):
        short, long = (_peak_memory(name, depth) for depth in (0.030, 0.120))
        what = f"{name}, memory of 1,000 x {STEPS}"
        yield Row(f"memory_{name}", what, "MB", long, "1,000 x 30 steps", short)


def noise_of(needle: int) -> list[float]:
    """Return the noise on x of one needle of the study [m]."""
    shares = (uniform_numbers(1, NOISE, k, needle, 1)[0, 0] for k in range(STEPS))
    return [float(TIP_NOISE * (2.0 * share - 1.0)) for share in shares]


def _plain_study() -> float:
    d = design()
    chosen = range(0, NEEDLES, NEEDLES // PLAIN_NEEDLES)
    needles = [(STARTS[k].tolist(), noise_of(k)) for k in chosen]
    seconds = _least_time(lambda: [reference_loop.steer(*needle, d) for needle in needles], 2)
    return seconds * NEEDLES / len(needles)


def _control_study() -> float:
    d = design()
    system = reference_loop.control_system(d)
    needles = [(STARTS[k].tolist(), noise_of(k)) for k in range(CONTROL_NEEDLES)]
    begin = time.process_time()
    for needle in needles:
        reference_loop.control_steer(system, *needle)
    return (time.process_time() - begin) * NEEDLES / len(needles)


def _peak_memory(name: str, depth: float) -> float:
    settings = dataclasses.replace(STUDY, depth=depth)
    factory = controller_factory(name, TIP_NOISE)
    run_study(STARTS[:2], factory, settings)
    tracemalloc.start()
    run_study(STARTS[:1000], factory, settings)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak / 1e6


def _study_one_by_one(name: str) -> float:
    """Return the time of the study with the same code, one needle at a time [s]."""
    factory = controller_factory(name, TIP_NOISE)
    chosen = range(0, NEEDLES, NEEDLES // ALONE_NEEDLES)
    return (
        _least_time(lambda: [run_study(STARTS[k : k + 1], factory, STUDY) for k in chosen], 1)
        * NEEDLES
        / len(chosen)
    )


def _tips_of_a_run(preset: str) -> list[tuple[FloatArray, JointSample]]:
    """Return the tips and joint positions of a closed-loop run."""
    control = PlaneControl(dataclasses.replace(SETTINGS, preset=preset, target_offset=0.003))
    needle = NeedleBatch(np.array([[0.0, np.deg2rad(2.0), np.deg2rad(15.0)]]))
    length, rotation = SETTINGS.step_length, 0.0
    taken = []
    for step in range(STEPS + 1):
        off = uniform_numbers(1, NOISE, step, 0, 1)[0, :3]
        tip = needle.tips[0] + TIP_NOISE * (2.0 * off - 1.0)
        taken.append((tip, JointSample(step, step * length, rotation)))
        turn = float(control.update(*taken[-1]).command.rotation_rate) * length
        needle.advance(length, turn, SETTINGS.curvature)
        rotation += turn
    return taken


def _update_all(preset: str, taken: Sequence[tuple[FloatArray, JointSample]]) -> None:
    control = PlaneControl(dataclasses.replace(SETTINGS, preset=preset, target_offset=0.003))
    for tip, joints in taken:
        estimate = control.update(tip, joints).estimate
        estimate.covariance  # noqa: B018 - lazy, and published


def _least_time(work: Callable[[], object], times: int) -> float:
    """Return the shortest CPU time of repeated work [s].

    CPU time depends only slightly on other load.
    """
    seconds = []
    for _ in range(times):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    return min(seconds)
