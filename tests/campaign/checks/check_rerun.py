"""Step E, `rerun`: an untouched bag comes out the same, a changed gain or sign does not."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from campaign.checking import Check, Finding, Workbench
from needle_bags.reading.bag_reader import read_run
from needle_bringup.descendants import busy, ran

REAL_TIME_BAGS = 30
LOAD = 15
_COMMAND = (sys.executable, "-m", "needle_analysis.ros.rerun")


def rerun_untouched(bench: Workbench) -> Iterator[Finding]:
    """Run bags of both levels, and one in real time, again: nothing differs."""
    runs = {
        "tip": ("--level", "tip", "--seed", "31"),
        "camera": ("--level", "camera", "--seed", "32"),
        "paper": ("--level", "tip", "--controller", "paper", "--seed", "33"),
        "real_time": ("--level", "camera", "--real-time-factor", "1", "--depth-mm", "15"),
    }
    for name, arguments in runs.items():
        bag = bench.run(f"rerun_{name}", *arguments).bag
        code, result = _rerun(bag)
        largest = {key: v for key, v in result.items() if "_largest_difference" in key and v}
        yield Finding(
            f"rerun_{name}",
            f"rerun of an untouched bag, {' '.join(arguments)}",
            "exit code 0, no message differs",
            f"exit code {code}, {_differing(result)} of {_compared(result)} messages differ"
            + (f", {len(largest)} fields not to the last bit" if largest else ", equal to the bit"),
            code == 0,
        )


def rerun_changed(bench: Workbench) -> Iterator[Finding]:
    """Change one gain by 1 %, or turn one sign in the projection: it is seen."""
    paper = bench.run("rerun_gain", "--level", "tip", "--controller", "paper", "--seed", "34").bag
    weights = read_run(paper).parameter("plane_controller", "state_weights")
    controller = "plane_controller"
    gain = {"state_weights": [1.01 * weights[0], *weights[1:]]}
    yield _red(paper, "gain", "the first state weight 1 % higher", controller, gain)
    camera = bench.run("rerun_sign", "--level", "camera", "--depth-mm", "20", "--seed", "35").bag
    curvature = {"curvature": 1.01 * read_run(camera).parameter(controller, "curvature")}
    yield _red(camera, "curvature", "the curvature 1 % higher", controller, curvature)
    calibration = yaml.safe_load(read_run(camera).calibration)
    calibration["left"]["T_optical_rig"]["rotation"][0] *= -1.0
    file = camera.with_name("turned.yaml")
    file.write_text(yaml.safe_dump(calibration), encoding="utf-8")
    sign = {"calibration_file": str(file)}
    yield _red(camera, "sign", "one sign of a camera's orientation turned", "stereo_tracker", sign)


def rerun_real_time(bench: Workbench, bags: int = REAL_TIME_BAGS) -> Iterator[Finding]:
    """Run real-time bags again, a third of them recorded on a machine that is busy."""
    red, unfinished = [], []
    for number in range(bags):
        loaded = number % 3 == 2
        name = f"rerun_real_time_{number}"
        speed = ("--level", "tip", "--real-time-factor", "4", "--depth-mm", "20")
        with busy(LOAD if loaded else 0):
            run = bench.run(name, *speed, "--seed", str(100 + number))
        if not (run.bag / "metadata.yaml").is_file():
            unfinished.append(name)
        elif _rerun(run.bag)[0] != 0:
            red.append(name)
    yield Finding(
        "rerun_real_time_bags",
        f"rerun of {bags} untouched real-time bags, a third recorded beside {LOAD} busy processes",
        "0 falsely red",
        f"{len(red)} red {', '.join(red)}"
        + (f"; {len(unfinished)} without a bag" if unfinished else ""),
        not red and not unfinished,
    )


CHECKS: tuple[Check, ...] = (rerun_untouched, rerun_changed, rerun_real_time)


def _red(bag: Path, key: str, what: str, node: str, values: Mapping[str, Any]) -> Finding:
    file = bag.with_name(f"{bag.name}_{key}.params.yaml")
    file.write_text(yaml.safe_dump({node: {"ros__parameters": dict(values)}}), encoding="utf-8")
    code, result = _rerun(bag, "--params", str(file))
    differing = _differing(result)
    return Finding(
        f"rerun_{key}",
        f"rerun with {what}",
        "exit code 1, and what differs",
        f"exit code {code}, {differing} of {_compared(result)} messages differ or are missing",
        code == 1 and differing > 0,
    )


def _rerun(bag: Path, *arguments: str) -> tuple[int, dict[str, Any]]:
    file = bag.with_name(f"{bag.name}.rerun.json")
    done = ran([*_COMMAND, str(bag), "--json", str(file), *arguments], good=(0, 1))
    return done.returncode, dict(json.loads(file.read_text(encoding="utf-8")))


def _compared(result: Mapping[str, Any]) -> int:
    return sum(value for key, value in result.items() if key.endswith("_messages"))


def _differing(result: Mapping[str, Any]) -> int:
    """Return messages with a difference, at least: each topic's worst field, and those missing."""
    topics = [key.removesuffix("_messages") for key in result if key.endswith("_messages")]
    total = 0
    for topic in topics:
        fields = [v for k, v in result.items() if k.startswith(topic) and k.endswith("_differing")]
        total += max(fields, default=0) + result[f"{topic}_missing"] + result[f"{topic}_extra"]
    return total
