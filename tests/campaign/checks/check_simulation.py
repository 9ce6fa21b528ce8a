"""Step A: the simulated rig steers end to end by one command."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from campaign.checking import Check, Finding, Workbench, at_most, bag_read_error
from needle_core.files.bag_directory import BagDirectory

SAME_TOPICS = ("/needle/tip", "/device/joint_trajectory", "/device/result", "/sim/tip_pose")
# Largest error over the last 20 mm [mm RMS], by options of `simulate`.
CONVERGING = {
    "--level drive": 1.0,
    "--level camera --insertion continuous": 0.06,
    "--level drive --insertion continuous": 0.06,
}


def camera(bench: Workbench) -> Iterator[Finding]:
    """Steer by images: converged, fast, with a readable bag and a report."""
    run = bench.run("level_camera_1", "--level", "camera")
    left = "; ".join(run.left_over)
    what, required = "scripts/simulate: exit code, what is left", "0, nothing"
    measured = f"{run.code}, {left or 'nothing'} ({run.last_line})"
    yield Finding("camera_ends", what, required, measured, run.code == 0 and not left)
    r1 = run.summary.get("r1_final_mm")
    required = "true, <= 1 mm"
    measured = f"{run.summary.get('converged')}, {r1} mm"
    passed = run.summary.get("converged") is True and abs(r1 or 9.0) <= 1.0
    yield Finding("camera_converged", "level camera: converged, |r1|", required, measured, passed)
    yield at_most("camera_wall", "its time", 40.0, run.wall, " s")
    why = bag_read_error(run.bag)
    yield Finding("camera_bag", "its bag", "opens with rosbags and mcap", why or "opens", not why)
    kinds = ("report.html", "summary.json", "parameters.yaml", "*.png")
    missing = ", ".join(kind for kind in kinds if not any(run.bag.glob(kind)))
    yield Finding("camera_files", "its folder", "all there", missing or "all there", not missing)


def same_seed(bench: Workbench) -> Iterator[Finding]:
    """Run the same seed twice: the same bits, with cameras and tracker in separate processes."""
    one, again = (bench.run(f"level_camera_{n}", "--level", "camera") for n in (1, 2))
    differ = _differences(one.bag, again.bag)
    measured = f"different: {', '.join(differ)}" if differ else "the same"
    required = "tips, commands, results and truth bit for bit"
    yield Finding("same_seed", "level camera, one seed twice", required, measured, not differ)


def converging(bench: Workbench) -> Iterator[Finding]:
    """Converge at level drive, and with continuous insertion."""
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


CHECKS: tuple[Check, ...] = (camera, same_seed, converging)


def _differences(one: Path, other: Path) -> list[str]:
    """Return the topics that are missing, or whose messages differ in any bit."""
    sent: list[dict[str, list[bytes]]] = []
    for bag in (one, other):
        sent.append({topic: [] for topic in SAME_TOPICS})
        with BagDirectory(bag) as directory:
            for message in directory.messages(SAME_TOPICS.__contains__):
                sent[-1][message.topic].append(message.data)
    return [
        topic for topic in SAME_TOPICS if not sent[0][topic] or sent[0][topic] != sent[1][topic]
    ]
