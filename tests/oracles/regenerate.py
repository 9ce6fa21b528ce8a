"""Makes the oracles anew from the commit that they freeze: `regenerate.py --help` says how."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import yaml

from needle_bags.format.bag_copy import BagCopy
from needle_bags.reading.bag_files import read_contents
from needle_bags.reading.bag_images import TOPICS as IMAGE_TOPICS
from needle_bags.reading.bag_images import pixels_of, plain_image
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory

ORACLES = Path(__file__).resolve().parent
ROOT = ORACLES.parents[1]
COMMIT = "d1224f940cecf8536e8c1bdb9d5ad086868d1b24"
BAGS, CAN, HELP = ORACLES / "bags", ORACLES / "can", ORACLES / "help"
TOPICS, PAIRS = ORACLES / "topics.json", ORACLES / "pairs.npz"
PAIRS_KEPT = 6
_BLOCK = 16  # [px]

DESCRIPTION = f"""\
Make the oracles anew: what the design with one process per node did, at commit {COMMIT[:8]}.

Checks that commit out into a temporary folder, sets it up (4 minutes), runs `scripts/simulate` and
--help of every command there, and writes into tests/oracles:
  bags/NAME      the run's bag, compressed, without images, /clock, /rosout, /parameter_events
  pairs.npz      level camera: the first pairs, each image as the means of blocks of 16 x 16 pixels
  can/NAME.txt   level drive: what the driver sent to the drives, by COB-ID (SDO requests, and
                 process data without repetitions)
  topics.json    level -> topic -> type, of all topics that were recorded
  help/NAME.txt  --help of each command, 100 columns wide
They are the reference for today's code: make them anew only if the runs or files below change,
never because today's code differs.
"""
EPILOG = """\
examples:
  source scripts/env.sh && python tests/oracles/regenerate.py
  python tests/oracles/regenerate.py --checkout ../old drive_best drive_best_continuous
      two runs only, in a checkout of that commit that is set up already
"""


@dataclasses.dataclass(frozen=True)
class FrozenRun:
    """A run of the frozen commit.

    Attributes
    ----------
    level : str
        What is simulated.
    options : str
        The other options of `scripts/simulate`.
    parameters : str
        Parameter file; empty: none.
    """

    level: str
    options: str = ""
    parameters: str = ""

    def words(self, bag: Path) -> list[str]:
        """Return the command line."""
        words = ["--level", self.level, "--depth-mm", "40", "--bag", str(bag)]
        if self.parameters:
            file = bag.with_suffix(".yaml")
            file.write_text(self.parameters, "utf-8")
            words += ["--params", str(file)]
        return ["scripts/simulate", *words, *shlex.split(self.options)]


# Seven processes that do not rest: on a busy machine a watchdog would break into the run.
_PATIENT = """\
sim_rig: {ros__parameters: {tick_timeout: 30.0}}
device_driver: {ros__parameters: {hold_timeout: 0.5}}
simulated_operator: {ros__parameters: {hold_rate: 50.0}}
"""


RUNS: Mapping[str, FrozenRun] = {
    "tip_best": FrozenRun("tip"),
    "tip_paper": FrozenRun("tip", "--controller paper"),
    "tip_open_loop": FrozenRun("tip", "--controller open_loop"),
    "tip_best_continuous": FrozenRun("tip", "--insertion continuous"),
    "tip_best_noiseless": FrozenRun("tip", "--noise-mm 0"),
    "tip_best_seed_2": FrozenRun("tip", "--seed 2"),
    "camera_best": FrozenRun("camera"),
    "drive_best": FrozenRun("drive"),
    "drive_best_continuous": FrozenRun("drive", "--insertion continuous", _PATIENT),
}
SCHEMA_RUNS = {"tip": "tip_best", "camera": "camera_best", "drive": "drive_best"}

# The clock says what the stamps say; parameters and logs name paths of the machine.
LEFT_OUT = ("/clock", "/rosout", "/parameter_events")
_NODES = ("sim_rig", "stereo_tracker", "plane_controller", "device_driver", "drive_emulator")
_OF_MACHINE = ("pty", "channel")

# Where the drive emulator takes a frame from the driver, and what is put before it.
_TAPPED = Path("ros2_ws/src/needle_sim/needle_sim/drives/drive_server.py")
_FRAME_TAKEN = "            self.bus.receive(frame, time.monotonic())\n"
_TAP = """\
            with open(__import__("os").environ["NEEDLE_CAN_LOG"], "a") as log:
                log.write(f"{frame.identifier:03X}#{frame.data.hex().upper()}\\n")
"""
_SDO_REQUESTS, _PROCESS_DATA = (0x600, 0x680), (0x200, 0x580)

_WRITE_HELP = """\
import sys
from pathlib import Path
from reference.command_pages import help_of_module, help_of_script, scripts
from reference.rig_nodes import executables
folder = Path(sys.argv[1])
texts = {name: help_of_module(module, name) for _, name, module in executables("command")}
texts["player"] = help_of_module("needle_bags.ros.player", "player")
texts |= {f"scripts_{name}": help_of_script(name) for name in scripts()}
for name, text in texts.items():
    (folder / f"{name}.txt").write_text(text, encoding="utf-8")
"""


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = CommandParser("regenerate.py", DESCRIPTION, EPILOG)
    parser.add_argument("names", nargs="*", metavar="NAME", help="runs, `help`; default: all")
    parser.add_argument(
        "--checkout", type=Path, metavar="DIR", help="a checkout of that commit that is set up"
    )

    def command() -> int:
        given = parser.parse_args()
        known = [*RUNS, "help"]
        for name in given.names:
            if name not in known:
                raise UserError(f"{name} is not one of {', '.join(known)}")
        with _checkout(given.checkout) as old, tempfile.TemporaryDirectory() as scratch:
            for name in given.names or known:
                print(f"regenerating {name}", file=sys.stderr)
                if name == "help":
                    _freeze_help(old)
                else:
                    _freeze_run(name, old, Path(scratch))
        return EXIT_DONE

    return run_command(command)


# ---- the frozen commit -------------------------------------------------------------------------


@contextlib.contextmanager
def _checkout(given: Path | None) -> Iterator[Path]:
    """Yield a checkout of the frozen commit that is set up."""
    if given is not None:
        _refuse_other_code(given)
        yield given.resolve()
        return
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "frozen"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(old), COMMIT], check=True)
        try:
            subprocess.run(["scripts/setup", "--quiet"], cwd=old, env=_environment(), check=True)
            yield old
        finally:
            subprocess.run([*git, "remove", "--force", str(old)], check=True)


def _refuse_other_code(folder: Path) -> None:
    said = subprocess.run(
        ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    if said != COMMIT:
        raise UserError(f"--checkout {folder} is at {said or 'no commit'}, not at {COMMIT}")


def _environment(**more: str) -> dict[str, str]:
    """Return an environment in which nothing leads to today's code."""
    kept = ("HOME", "LANG", "LC_ALL", "TMPDIR", "TERM")
    today = str(Path(sys.prefix))
    path = [p for p in os.environ["PATH"].split(os.pathsep) if not p.startswith(today)]
    own = {name: os.environ[name] for name in kept if name in os.environ}
    return {**own, "PATH": os.pathsep.join(path), **more}


@contextlib.contextmanager
def _tapped_bus(old: Path) -> Iterator[None]:
    """Let the drive emulator write down each frame that the driver sends."""
    file = old / _TAPPED
    text = file.read_text("utf-8")
    assert text.count(_FRAME_TAKEN) == 1, f"{_TAPPED}: where is a frame taken?"
    file.write_text(text.replace(_FRAME_TAKEN, _TAP + _FRAME_TAKEN), "utf-8")
    try:
        yield
    finally:
        file.write_text(text, "utf-8")


# ---- what is frozen ----------------------------------------------------------------------------


def _freeze_run(name: str, old: Path, scratch: Path) -> None:
    run, bag, log = RUNS[name], scratch / name, scratch / f"{name}.can"
    words = run.words(bag)
    tap = _tapped_bus(old) if run.level == "drive" else contextlib.nullcontext()
    with tap:
        environment = _environment(NEEDLE_CAN_LOG=str(log))
        done = subprocess.run(words, cwd=old, env=environment, check=False)
    # A run that misses the plane is as good for comparing.
    if done.returncode not in (EXIT_DONE, EXIT_MISSED):
        raise UserError(f"{shlex.join(words)} ended with {done.returncode}")
    BAGS.mkdir(exist_ok=True)
    shutil.rmtree(BAGS / name, ignore_errors=True)
    copy_without_images(bag, BAGS / name)
    if run.level == "drive":
        CAN.mkdir(exist_ok=True)
        (CAN / f"{name}.txt").write_text(transcript(log.read_text().splitlines()), "utf-8")
    if run.level == "camera":
        _freeze_pairs(bag)
    if SCHEMA_RUNS[run.level] == name:
        _freeze_topics(run.level, bag)
    shutil.rmtree(bag)


def copy_without_images(source: Path, target: Path) -> None:
    """Copy a bag, compressed, without images and what names the machine."""
    contents = read_contents(source)
    left_out = {*LEFT_OUT, *(f"/{topic}" for topic in IMAGE_TOPICS)}
    parameters = {
        node: {
            "ros__parameters": {
                key: value
                for key, value in values["ros__parameters"].items()
                if key not in _OF_MACHINE
            }
        }
        for node, values in yaml.safe_load(contents.custom_data["parameters"]).items()
        if node.rpartition("/")[2] in _NODES
    }
    custom_data = {
        "parameters": yaml.safe_dump(parameters),
        **{key: contents.custom_data[key] for key in ("run_info", "calibration")},
        "commit": COMMIT,
    }
    copy = BagCopy(target, contents.distribution, custom_data)
    with BagDirectory(source) as bag:
        for message in bag.messages(lambda topic: topic not in left_out):
            topic = contents.topics[message.topic]
            copy.put(topic, message.data, message.log_time, message.time)
    copy.close()


def transcript(frames: list[str]) -> str:
    """Return what matters of the frames `ID#DATA` that a driver sent, grouped by COB-ID.

    All SDO requests of a node, in their order; of process data what differs from the frame before.
    SYNC, heartbeats and network management go by time, and are left out.
    """
    sent: dict[int, list[str]] = {}
    for frame in frames:
        sent.setdefault(int(frame.partition("#")[0], 16), []).append(frame)
    lines: list[str] = []
    for cob_id, own in sorted(sent.items()):
        if _SDO_REQUESTS[0] <= cob_id < _SDO_REQUESTS[1]:
            lines += own
        elif _PROCESS_DATA[0] <= cob_id < _PROCESS_DATA[1]:
            lines += [frame for frame, _ in itertools.groupby(own)]
    return "".join(f"{line}\n" for line in lines)


def _freeze_pairs(source: Path) -> None:
    sides: dict[str, list[npt.NDArray[np.float32]]] = {"left": [], "right": []}
    with BagDirectory(source) as bag:
        store = bag.typestore()
        for message in bag.messages(lambda topic: topic.removeprefix("/") in IMAGE_TOPICS):
            means = sides[IMAGE_TOPICS[message.topic.removeprefix("/")]]
            if len(means) < PAIRS_KEPT:
                image = plain_image(bag.deserialize(store, message))
                means.append(block_means(pixels_of(image, source)))
    np.savez_compressed(PAIRS, left=np.array(sides["left"]), right=np.array(sides["right"]))


def block_means(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Return the mean of each block of 16 x 16 pixels."""
    height, width = pixels.shape
    blocks = pixels.reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    means: npt.NDArray[np.float32] = blocks.mean((1, 3), dtype=np.float32)
    return means


def _freeze_topics(level: str, bag: Path) -> None:
    levels = json.loads(TOPICS.read_text("utf-8")) if TOPICS.exists() else {}
    topics = read_contents(bag).topics.values()
    levels[level] = {topic.name: topic.type_name for topic in topics}
    TOPICS.write_text(json.dumps(levels, indent=1, sort_keys=True) + "\n", "utf-8")


def _freeze_help(old: Path) -> None:
    shutil.rmtree(HELP, ignore_errors=True)
    HELP.mkdir()
    script = '. scripts/env.sh && cd scripts/lib && python -c "$1" "$2"'
    words = ["bash", "-c", script, "bash", _WRITE_HELP, str(HELP)]
    subprocess.run(words, cwd=old, env=_environment(), check=True)


if __name__ == "__main__":
    sys.exit(main())
