"""Step A: the rig steers end to end in simulation, from one command."""

from __future__ import annotations

import itertools
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

from campaign.checking import Check, Finding, SimulateRun, Workbench, payloads, unreadable

SAME_TOPICS = ("/needle/tip", "/device/joint_trajectory", "/device/result", "/sim/tip_pose")
# Options of simulate -> what the error over the last 20 mm may be [mm RMS].
CONVERGING = {
    "--level drive": 1.0,
    "--level camera --insertion continuous": 0.06,
    "--level drive --insertion continuous": 0.06,
}
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
_GRAPH = ("--level", "tip", "--graph")


def camera(bench: Workbench) -> Iterator[Finding]:
    """Steer by images: converged, quick, with a bag that opens and a report."""
    run = bench.run("level_camera_1", "--level", "camera")
    yield _ends(run, "camera", "scripts/simulate", 0)
    r1 = run.summary.get("r1_final_mm")
    wanted = "true, <= 1 mm"
    seen = f"{run.summary.get('converged')}, {r1} mm"
    passed = run.summary.get("converged") is True and abs(r1 or 9.0) <= 1.0
    yield Finding("camera_converged", "level camera: converged, |r1|", wanted, seen, passed)
    yield Finding("camera_wall", "its time", "< 40 s", f"{run.wall:.1f} s", run.wall < 40.0)
    why = unreadable(run.bag)
    yield Finding("camera_bag", "its bag", "opens with rosbags and mcap", why or "opens", not why)
    kinds = ("report.html", "summary.json", "parameters.yaml", "*.png")
    missing = ", ".join(kind for kind in kinds if not any(run.bag.glob(kind)))
    yield Finding("camera_files", "its folder", "all there", missing or "all there", not missing)


def open_loop(bench: Workbench) -> Iterator[Finding]:
    """End where the constant curvature takes the needle, not steered."""
    arguments = ("--controller", "open_loop", "--level", "tip", "--noise-mm", "0")
    run = bench.run("open_loop", *arguments)
    r1 = run.summary.get("r1_final_mm") or 0.0
    what, wanted = "open loop: r1 at 120 mm", "14.6 +- 0.1 mm"
    yield Finding("open_loop_r1_final", what, wanted, f"{r1} mm", abs(r1 - 14.6) <= 0.1)
    yield _ends(run, "open_loop", "open loop", 1)


def same_seed(bench: Workbench) -> Iterator[Finding]:
    """One seed, one run, bit for bit, with cameras and tracker in processes of their own."""
    one, again = (bench.run(f"level_camera_{n}", "--level", "camera") for n in (1, 2))
    differ = _differences(one.bag, again.bag)
    seen = f"different: {', '.join(differ)}" if differ else "the same"
    wanted = "tips, commands, results and truth bit for bit"
    yield Finding("same_seed", "level camera, one seed twice", wanted, seen, not differ)


def converging(bench: Workbench) -> Iterator[Finding]:
    """Converge at level drive, and while a person holds."""
    for options, largest in CONVERGING.items():
        name = options.replace("--", "").replace(" ", "_")
        summary = bench.run(name, *options.split()).summary
        converged, rms = summary.get("converged"), summary.get("r1_rms_last_20_mm") or 9.0
        yield Finding(
            f"converged_{name}",
            f"{options}: converged, r1 over the last 20 mm",
            f"True, <= {largest:g} mm RMS",
            f"{converged}, {rms:.3f} mm RMS",
            converged is True and rms <= largest,
        )


def tip_speed(bench: Workbench) -> Iterator[Finding]:
    """Run without images quickly."""
    run = bench.run("level_tip_1", "--level", "tip")
    what, steps = "level tip: from the command to the result of 120 steps", run.summary.get("steps")
    seen = f"{steps} steps in {run.wall:.1f} s"
    yield Finding("tip_speed", what, "< 10 s", seen, steps == 120 and run.wall < 10.0)


def interrupt(bench: Workbench) -> Iterator[Finding]:
    """Interrupted at any moment: exit code 130, no process left, the bag readable."""
    # when a run is interrupted is random, but the same each time this runs
    generator = random.Random(2009)
    for number, (milestone, latest) in enumerate(MILESTONES):
        delay = latest * generator.random()
        kind = generator.choice((signal.SIGINT, signal.SIGTERM))
        started = bench.start(f"interrupt_{number}", *_GRAPH)
        started.wait_until_said(milestone)
        time.sleep(delay)
        started.interrupt(kind)
        what = f"{kind.name} {delay:.2f} s after '{milestone or 'the command'}'"
        yield _ends(started.wait(60.0), f"interrupt_{number}", what, 130)


def kill_simulate(bench: Workbench) -> Iterator[Finding]:
    """Kill -9 the command, or one of its nodes: all others end, and who died is named."""
    started = bench.start("killed_command", *_GRAPH)
    started.wait_until_said(MILESTONES[3][0])
    started.process.kill()
    deadline = time.monotonic() + 60.0
    while (left := started.running()) and time.monotonic() < deadline:
        time.sleep(0.05)
    yield Finding("killed_command", "simulate killed: its nodes", "end", f"{left}", not left)
    started = bench.start("killed_node", *_GRAPH)
    started.wait_until_said(MILESTONES[3][0])
    (pid,) = [pid for pid, command in started.running() if "plane_controller" in command]
    os.kill(pid, signal.SIGKILL)
    run = started.wait(60.0)
    yield _ends(run, "killed_node", "plane_controller killed", 2)
    wanted = "plane_controller ended with signal SIGKILL"
    seen = run.last_line
    yield Finding("killed_node_named", "what is said of it", wanted, seen, wanted in seen)


CHECKS: tuple[Check, ...] = (
    camera, open_loop, same_seed, converging, tip_speed, interrupt, kill_simulate,
)  # fmt: skip


def _ends(run: SimulateRun, key: str, what: str, code: int) -> Finding:
    why = unreadable(run.bag) if run.bag.exists() else ""
    seen = f"{run.code}, left: {'; '.join(run.left_over) or 'nothing'}, {why or 'reads'}"
    if run.code != code or "warning" in run.output:
        seen += f" ({run.last_line})"
    return Finding(
        f"{key}_ends",
        f"{what}: exit code, what is left, its bag",
        f"{code}, nothing, reads (or is not begun)",
        seen,
        run.code == code and not run.left_over and not why,
    )


def _differences(one: Path, other: Path) -> list[str]:
    """Return the topics whose messages differ in any bit, or are not there.

    Where simulated time stands still what is said is repeated: each thing counts once.
    """
    told = [
        {topic: [data for data, _ in itertools.groupby(said)] for topic, said in messages.items()}
        for messages in (payloads(one, SAME_TOPICS), payloads(other, SAME_TOPICS))
    ]
    return [
        topic for topic in SAME_TOPICS if told[0][topic] != told[1][topic] or not told[0][topic]
    ]
