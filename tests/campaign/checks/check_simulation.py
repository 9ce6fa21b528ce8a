"""Step A: the rig steers end to end in simulation, from one command."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from campaign.checking import (
    Check,
    Finding,
    SimulateRun,
    Workbench,
    payloads,
    unreadable,
)

SAME_TOPICS = ("/needle/tip", "/device/joint_trajectory", "/sim/tip_pose")
# What a run has said -> at most how long after that it is interrupted [s].
MILESTONES = (
    ("", 0.3),
    ("ROS_DOMAIN_ID", 0.5),
    ("ROS_DOMAIN_ID", 4.0),
    (r"3\d\.\d of", 0.5),
    (r"6\d\.\d of", 0.5),
    ("simulated_operator: inserted", 0.1),
    ("simulated_operator: inserted", 1.0),
)
SEED = 2009


def camera(bench: Workbench) -> Iterator[Finding]:
    """Steer by images: converged, quick, with a bag that opens and a report."""
    run = bench.run("camera_1")
    yield _exit(run, "camera", "scripts/simulate", 0)
    summary = run.summary
    yield Finding(
        "camera_converged",
        "level camera: converged",
        "true",
        str(summary.get("converged")),
        summary.get("converged") is True,
    )
    r1 = summary.get("r1_final_mm")
    yield Finding(
        "camera_r1_final",
        "level camera: |r1| at 120 mm against the truth",
        "<= 1 mm",
        f"{r1} mm" if r1 is not None else f"no result: {run.last_line}",
        isinstance(r1, float) and abs(r1) <= 1.0,
    )
    wall = run.wall
    yield Finding("camera_wall", "second run", "< 40 s", f"{wall:.1f} s", wall < 40.0)
    why = unreadable(run.bag)
    yield Finding("camera_bag", "its bag", "opens with rosbags and mcap", why or "opens", not why)
    missing = [
        name
        for name in ("report.html", "summary.json", "parameters.yaml")
        if not (run.bag / name).is_file()
    ]
    missing += [] if any(run.bag.glob("*.png")) else ["*.png"]
    seen = f"without {', '.join(missing)}" if missing else "all there"
    yield Finding("camera_files", "its folder", "report, figures, summary", seen, not missing)


def open_loop(bench: Workbench) -> Iterator[Finding]:
    """End where the constant curvature takes the needle, not steered."""
    arguments = ("--controller", "open_loop", "--level", "tip", "--noise-mm", "0")
    run = bench.run("open_loop", *arguments)
    r1 = run.summary.get("r1_final_mm")
    yield Finding(
        "open_loop_r1_final",
        "open loop: r1 at 120 mm",
        "14.6 +- 0.1 mm",
        f"{r1} mm" if r1 is not None else f"no result: {run.last_line}",
        isinstance(r1, float) and abs(r1 - 14.6) <= 0.1,
    )
    yield _exit(run, "open_loop", "open loop", 1)


def same_seed(bench: Workbench) -> Iterator[Finding]:
    """One seed, one run, bit for bit; another seed, another run."""
    for level in ("tip", "camera"):
        one = bench.run(f"{level}_1", "--level", level)
        again = bench.run(f"{level}_1_again", "--level", level)
        differ = _differences(one.bag, again.bag)
        counts = {name: len(data) for name, data in payloads(one.bag, SAME_TOPICS).items()}
        yield Finding(
            f"same_seed_{level}",
            f"level {level}: twice the same seed",
            "tips, commands and truth bit for bit",
            f"different: {', '.join(differ)}" if differ else f"same: {counts}",
            not differ and all(counts.values()),
        )
        trips = one.summary.get("watchdog_trips"), again.summary.get("watchdog_trips")
        yield Finding(
            f"same_seed_{level}_trips", "  watchdog trips", "0 and 0", str(trips), trips == (0, 0)
        )
    other = bench.run("tip_2", "--level", "tip", "--seed", "2")
    differ = _differences(bench.run("tip_1", "--level", "tip").bag, other.bag)
    yield Finding(
        "other_seed",
        "level tip: another seed",
        "all differ",
        f"different: {', '.join(differ)}",
        len(differ) == len(SAME_TOPICS),
    )


def tip_speed(bench: Workbench) -> Iterator[Finding]:
    """Run without images quickly."""
    run = bench.run("tip_1", "--level", "tip")
    steps = run.summary.get("steps")
    yield Finding(
        "tip_speed",
        "level tip: from the command to the result of 120 steps",
        "< 10 s",
        f"{steps} steps in {run.wall:.1f} s",
        steps == 120 and run.wall < 10.0,
    )


def interrupt(bench: Workbench) -> Iterator[Finding]:
    """Interrupted at any moment: exit code 130, no process left, the bag readable."""
    # when a run is interrupted is random, but the same each time this runs
    generator = random.Random(SEED)
    for number, (milestone, latest) in enumerate(MILESTONES):
        delay = latest * generator.random()
        kind = generator.choice((signal.SIGINT, signal.SIGTERM))
        started = bench.start(f"interrupt_{number}", "--level", "tip", "--graph")
        started.wait_until_said(milestone)
        time.sleep(delay)
        started.interrupt(kind)
        run = started.wait(60.0)
        why = unreadable(run.bag) if run.bag.exists() else ""
        bag = f"bag unreadable ({why})" if why else "bag reads" if run.bag.exists() else "no bag"
        seen = f"exit code {run.code}, {len(run.left_over)} processes left, {bag}"
        if run.left_in_memory:
            seen += f", left in shared memory: {', '.join(run.left_in_memory)}"
        if "warning" in run.output:
            seen += f" ({run.output.partition('warning')[2].strip()})"
        yield Finding(
            f"interrupt_{number}",
            f"{kind.name} {delay:.2f} s after '{milestone or 'the command'}'",
            "exit code 130, 0 processes left, bag reads (or is not begun)",
            seen,
            run.code == 130 and not run.left_over and not why and not run.left_in_memory,
        )


def bad_parameter(bench: Workbench) -> Iterator[Finding]:
    """Name an unknown parameter or node in a file, and run nothing."""
    files = {
        "plane_controller: {ros__parameters: {curvatur: 9.0}}": "curvatur",
        "plane_controler: {ros__parameters: {curvature: 9.0}}": "plane_controler",
        "plane_controller: {ros__parameters: {curvature: .nan}}": "curvature",
    }
    for number, (text, named) in enumerate(files.items()):
        path = bench.folder / f"bad_{number}.yaml"
        path.write_text(text, encoding="utf-8")
        run = bench.run(f"bad_parameter_{number}", "--level", "tip", "--params", str(path))
        left = "a bag is left" if run.bag.exists() else "no bag left"
        yield Finding(
            f"bad_parameter_{number}",
            text,
            f"exit code 2, {named} named in the last line, nothing left",
            f"exit code {run.code}, {left}, {len(run.left_over)} processes: {run.last_line}",
            run.code == 2
            and named in run.last_line
            and not run.bag.exists()
            and not run.left_over
            and "Traceback" not in run.output,
        )


CHECKS: tuple[Check, ...] = (
    camera,
    open_loop,
    same_seed,
    tip_speed,
    interrupt,
    bad_parameter,
)


def _exit(run: SimulateRun, key: str, what: str, code: int) -> Finding:
    left = f", left: {'; '.join(run.left_over)}" if run.left_over else ""
    seen = f"{run.code}{left}"
    if run.code != code:
        seen += f" ({run.last_line})"
    passed = run.code == code and not run.left_over
    return Finding(
        f"{key}_exit_code", f"{what}: exit code, processes left", str(code), seen, passed
    )


def _differences(one: Path, other: Path, topics: Sequence[str] = SAME_TOPICS) -> list[str]:
    """Return the topics whose messages differ in any bit."""
    ours, theirs = payloads(one, topics), payloads(other, topics)
    return [topic for topic in topics if ours[topic] != theirs[topic]]
