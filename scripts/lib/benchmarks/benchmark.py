"""`scripts/bench`: every speed and memory figure beside its reference, measured in the same run."""

from __future__ import annotations

import dataclasses
import itertools
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

import drive_benchmark
import latency_benchmark
import recording_benchmark
import reference_loop
import tracker_benchmark
from needle_bringup.studies.study_controllers import controller_factory, needles_at_a_time
from needle_bringup.workplace import ending_descendants
from needle_controller.model.gains import sampled_observer_gain
from needle_controller.model.reachability import reachability
from needle_controller.model.target_plane import offset_plane
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser, output_file
from needle_core.errors import UserError
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.disturbances import NOISE, Disturbances, uniform_numbers
from needle_sim.studies.needles import NeedleBatch
from needle_sim.studies.study import GRIDS, StartBounds, StudySettings, run_study

DESCRIPTION = """\
Measure what is fast enough and what is not, each figure beside a reference in the same run: the
machine's own speed falls out of the ratio.
"""
EPILOG = """\
references:
  plain Python     the same loop, needle by needle, with numbers and `math` (few needles, scaled)
  python-control   the same loop as interconnected systems of python-control (fewer, scaled); its
                   time of one update holds the needle's simulation, too
  rosbags Writer   the same messages into an MCAP bag; the disk alone: their bytes into one file;
                   all with what the disk needs to take them (fsync)
  a frame          the time from one exposure to the next, 30 a second
  one at a time    the same code as the study's, in a loop over needles (few needles, scaled)

exit codes: 0 measured, 2 bad input, 130 interrupted.
"""
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


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure beside its reference; `value` and `reference` in the unit of `unit`."""

    key: str
    what: str
    unit: str
    value: float
    against: str
    reference: float

    @property
    def ratio(self) -> float:
        """Ratio of the value to the reference."""
        return self.reference / self.value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bench`; returns its exit code."""
    return run_command(lambda: _bench(sys.argv[1:] if arguments is None else arguments))


def _bench(arguments: Sequence[str]) -> int:
    parser = CommandParser("bench", DESCRIPTION, EPILOG)
    parser.add_argument("--json", metavar="FILE", help="write the figures as one flat JSON object")
    parser.add_argument("--only", metavar="WORD", help="only rows whose name has this in it")
    given = parser.parse_args(arguments)
    file = output_file("--json", given.json)
    benches = {name: bench for name, bench in BENCHES.items() if (given.only or "") in name}
    if not benches:
        raise UserError(f"--only {given.only!r} is not in {', '.join(BENCHES)}")
    values: dict[str, JsonValue] = {}
    print(f"{'':34}{'here':>12}  {'reference':>12}  {'ratio':>8}")
    with ending_descendants():
        for row in itertools.chain.from_iterable(bench() for bench in benches.values()):
            print(
                f"{row.what:34}{row.value:10.4g} {row.unit:2} {row.reference:10.4g} {row.unit:2} "
                f"{row.ratio:7.3g}x  {row.against}",
                flush=True,
            )
            unit = row.unit.replace("%", "percent")
            values[f"{row.key}_{unit}"] = row.value
            name = row.against.replace(" ", "_").replace("-", "_").replace(",", "").lower()
            values[f"{row.key}_{name}_{unit}"] = row.reference
            values[f"{row.key}_{name}_ratio"] = row.ratio
    if file is not None:
        write_json(file, values)
    return EXIT_DONE


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
    """10,000 needles x 120 steps."""
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
    """One update of the node's controller: estimate with covariance, command, reach."""
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
    """Peak memory of a study: it must not grow with the steps."""
    for name in ("paper", "best"):
        short, long = (_peak_memory(name, depth) for depth in (0.030, 0.120))
        what = f"{name}, memory of 1,000 x {STEPS}"
        yield Row(f"memory_{name}", what, "MB", long, "1,000 x 30 steps", short)


def tracker() -> Iterator[Row]:
    """From a stereo pair to a tip: time and 95 % error beside the plain OpenCV ways."""
    ways = {way.key: way for way in tracker_benchmark.ways()}
    for way in (ways["full"], ways["region"]):
        key, what = f"tracker_{way.key}", way.what
        pair = f"{what}, a pair ({way.pairs_per_s:.0f}/s)"
        for plain in (ways["plain"], ways["plain_corrected"]):
            times = 1e3 / way.pairs_per_s, plain.what, 1e3 / plain.pairs_per_s
            errors = way.distance_p95_mm, plain.what, plain.distance_p95_mm
            yield Row(f"{key}_pair", pair, "ms", *times)
            yield Row(f"{key}_error", f"{what}, 95 % error", "mm", *errors)


def drives() -> Iterator[Row]:
    """Run the 50 Hz cycle of both drives over a serial adapter: delay and share of a core."""
    driver, *others = drive_benchmark.ways()
    for other in others:
        delays = driver.delay_p99_ms, other.what, other.delay_p99_ms
        shares = driver.cpu_percent, other.what, other.cpu_percent
        yield Row("drives_delay_p99", "50 Hz cycle, p99 until SYNC is out", "ms", *delays)
        yield Row("drives_cpu", "50 Hz cycle, share of a core", "%", *shares)


def recording() -> Iterator[Row]:
    """From messages to a bag on the disk."""
    speeds = recording_benchmark.measure()
    size = speeds.megabytes
    for against, speed in (("rosbags Writer", speeds.rosbags), ("the disk alone", speeds.disk)):
        what = f"recorder's writer, {size:.0f} MB"
        yield Row("recording", what, "s", size / speeds.recorder, against, size / speed)


def reception() -> Iterator[Row]:
    """Stereo images at 2 x 30 Hz over DDS, and what they cost the recorder."""
    found = recording_benchmark.reception()
    against = "a bare subscriber"
    yield Row("stereo_received", "stereo recorded", "%", found["recorded"], against, found["heard"])
    yield Row("recorder_core", "recorder, share of a core", "%", found["core"], "one core", 100.0)


def latency() -> Iterator[Row]:
    """From both images to the set-points made from them, recorder and console running."""
    for stage, (median, worst) in latency_benchmark.measure().items():
        key = f"latency_{stage.replace(' ', '_').replace('-', '_')}"
        for name, seconds in (("p50", median), ("p99", worst)):
            frame = 1e3 * latency_benchmark.FRAME
            yield Row(f"{key}_{name}", f"{stage}, {name}", "ms", 1e3 * seconds, "a frame", frame)


BENCHES: dict[str, Callable[[], Iterator[Row]]] = {
    "studies": studies,
    "updates": updates,
    "memory": memory,
    "tracker": tracker,
    "recording": recording,
    "reception": reception,
    "drives": drives,
    "latency": latency,
}


def noise_of(needle: int) -> list[float]:
    """Return the noise on x that the study gives one of its needles."""
    shares = (uniform_numbers(1, NOISE, k, needle, 1)[0, 0] for k in range(STEPS))
    return [float(TIP_NOISE * (2.0 * share - 1.0)) for share in shares]


def _plain_study() -> float:
    d = design()
    chosen = range(0, NEEDLES, NEEDLES // PLAIN_NEEDLES)
    needles = [(STARTS[k].tolist(), noise_of(k)) for k in chosen]
    seconds = _least_time(lambda: [reference_loop.steer(*needle, d) for needle in needles], 2)
    ends = [reference_loop.steer(*needle, d) for needle in needles]
    seen = run_study(STARTS, controller_factory("paper", TIP_NOISE), STUDY).x_end[list(chosen)]
    _require_agreement("plain Python", seen.tolist(), ends)
    return seconds * NEEDLES / len(needles)


def _control_study() -> float:
    d = design()
    system = reference_loop.control_system(d)
    needles = [(STARTS[k].tolist(), noise_of(k)) for k in range(CONTROL_NEEDLES)]
    begin = time.process_time()
    ends = [reference_loop.control_steer(system, *needle) for needle in needles]
    seconds = time.process_time() - begin
    _require_agreement(
        "python-control", ends, [reference_loop.steer(*needle, d) for needle in needles]
    )
    return seconds * NEEDLES / len(needles)


def _require_agreement(name: str, one: Sequence[float], other: Sequence[float]) -> None:
    """Refuse to compare loops that do not compute the same."""
    off = max(abs(a - b) for a, b in zip(one, other, strict=True))
    if off > 1e-6:
        raise UserError(f"the loop in {name} ends up to {off:g} m away: not the same loop")


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
    """Return the time of the study with the same code in a loop over needles, each alone."""
    factory = controller_factory(name, TIP_NOISE)
    chosen = range(0, NEEDLES, NEEDLES // ALONE_NEEDLES)
    return (
        _least_time(lambda: [run_study(STARTS[k : k + 1], factory, STUDY) for k in chosen], 1)
        * NEEDLES
        / len(chosen)
    )


def _tips_of_a_run(preset: str) -> list[tuple[FloatArray, JointSample]]:
    """Return what the node takes over a whole closed-loop run."""
    control = PlaneControl(dataclasses.replace(SETTINGS, preset=preset), offset_plane(0.003))
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
    control = PlaneControl(dataclasses.replace(SETTINGS, preset=preset), offset_plane(0.003))
    for tip, joints in taken:
        estimate = control.update(tip, joints).estimate
        estimate.covariance  # noqa: B018 - lazy, and published
        reachability(estimate.reduced, estimate.curvature, insertion=joints.insertion, end=0.12)


def _least_time(work: Callable[[], object], times: int) -> float:
    """Return the shortest of some times [s] of this process on the processor.

    All that is measured runs in one thread; what else the machine does counts for little.
    """
    seconds = []
    for _ in range(times):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    return min(seconds)


if __name__ == "__main__":
    sys.exit(main())
