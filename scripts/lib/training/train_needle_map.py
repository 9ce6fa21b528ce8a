"""Train the network that detects needles: pixels of the shaft, and the end of the shaft.

The network learns from samples of randomly path-traced scenes and from drawn samples. The folder of
the run keeps everything: --resume continues an ended or interrupted training. On two cores it takes
about two hours: half an hour for 140 scenes, then the training.

With --own the training continues with a recording of your own rig: FOLDER has calibration.yaml,
empty/left and empty/right (an insertion without needle), needle/left, needle/right and
needle/insertion.csv (an insertion with needle; files as for track_images). The path of the tips
that the tracker accepts gives the position of the shaft, also in the pairs between them. A fifth of
the pairs is held out; the report compares the network on them before and after.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
from tqdm import tqdm

from needle_bringup.training.traced_scenes import trace_scene
from needle_core.commands.cli import run_command
from needle_core.commands.options import CommandParser
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_sim.path_traced.tracer import load_mitsuba
from needle_sim.sequences.boxes import draw_box
from net_report import report
from own_scenes import own_scenes
from sample_pool import (
    SHARD,
    Pool,
    read_scene,
    scene_paths,
    supply,
    write_scene,
)

if TYPE_CHECKING:
    from training_net import NeedleNet

ROOT = Path(__file__).parents[3]
TRACKER = ROOT / "ros2_ws/src/needle_tracker"
WEIGHTS = TRACKER / "needle_tracker/detector/needle_net.onnx"
CALIBRATIONS = (
    TRACKER / "config/calibration.yaml",
    TRACKER / "config/calibration_top_and_side.yaml",
)
_MINUTES, _OWN_MINUTES = 90.0, 30.0
_POLL = 5.0  # [s]
_OWN, _OWN_HELD_OUT = "0.npz", "9.npz"
_EXAMPLES = """examples:
  scripts/train_needle_map
      train from scratch; replaces the tracker's weights every 3 minutes and at the end
  scripts/train_needle_map --resume
      continue from the last checkpoint
  scripts/train_needle_map --scenes 12 --drawn 10 --steps 2000 --folder /tmp/try \\
          --output /tmp/try/needle_net.onnx
      a first trial of about half an hour, which keeps the tracker's weights
  scripts/train_needle_map --own recordings/monday --needle-width-mm 1.3
      improve the detection on your own rig; half an hour
  scripts/train_needle_map --report --folder /tmp/try --output /tmp/try/needle_net.onnx
      evaluate a network on scenes that were not used for training

The result depends slightly on the machine: another run gives a different network of similar
quality. Scenes whose number ends in 9 are held out for the report.
"""


def rig_of(seed: int) -> StereoRig:
    """Return the cameras of a scene, given its seed."""
    if seed % 2 == 0:
        return load_stereo_rig(CALIBRATIONS[seed // 2 % 2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "box.yaml")
        path.write_text(draw_box(seed), encoding="utf-8")
        return load_stereo_rig(path)


def trace_all(count: int, folder: Path) -> None:
    """Trace the missing scenes, alternately on the bench and in a box.

    Parameters
    ----------
    count : int
        Number of scenes.
    folder : Path
        Output folder, with a file for each scene.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{seed}.npz" for seed in range(count)]
    missing = [seed for seed, path in enumerate(paths) if not path.exists()]
    if not missing:
        return
    mitsuba = load_mitsuba()
    for seed in tqdm(missing, "tracing scenes", unit="scene"):
        write_scene(paths[seed], trace_scene(mitsuba, rig_of(seed), seed))


def wait_for_samples(folder: Path, drawn: int, process: BaseProcess) -> None:
    """Wait for samples of both kinds.

    Parameters
    ----------
    folder : Path
        Folder of the samples.
    drawn : int
        Required number of files of each kind.
    process : Process
        Process that draws them.
    """
    with tqdm(total=2 * drawn, desc="drawing samples", unit=f"x{SHARD}") as bar:
        while bar.n < bar.total:
            files = (len(list(folder.glob(f"{kind}-*.npz"))) for kind in ("drawn", "traced"))
            bar.update(sum(min(n, drawn) for n in files) - bar.n)
            if not process.is_alive():
                raise SystemExit("the sample generator has ended: its error is above")
            if bar.n < bar.total:
                time.sleep(_POLL)


def read_arguments() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = CommandParser("scripts/train_needle_map", __doc__ or "", _EXAMPLES)
    parser.add_argument("--steps", type=int, default=24000, metavar="N", help="default: 24000")
    parser.add_argument(
        "--minutes",
        type=float,
        metavar="M",
        help="maximum duration of the training [min]; "
        f"default: {_MINUTES:.0f}, with --own {_OWN_MINUTES:.0f}",
    )
    parser.add_argument("--scenes", type=int, default=140, metavar="N", help="default: 140")
    parser.add_argument(
        "--drawn",
        type=int,
        default=150,
        metavar="N",
        help=f"files of {SHARD} samples, each of drawn and of traced ones; default: 150",
    )
    parser.add_argument(
        "--folder",
        type=Path,
        metavar="DIR",
        help="folder for scenes and samples, made only once (8 GB); default: .training/run, with "
        "--own .training/own",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=WEIGHTS,
        metavar="FILE.onnx",
        help="file for the weights; default: the tracker's; the checkpoint is in the folder",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue from the last checkpoint in the folder, or else from --output",
    )
    parser.add_argument(
        "--report",
        action="store_true",
        help="only evaluate the network from which --resume would continue",
    )
    parser.add_argument("--own", type=Path, metavar="FOLDER", help="train on your own recording")
    parser.add_argument(
        "--needle-width-mm", type=float, default=0.7, metavar="W", help="with --own; default: 0.7"
    )
    given = parser.parse_args()
    own = given.own is not None
    given.folder = given.folder or ROOT / ".training" / ("own" if own else "run")
    given.minutes = given.minutes or (_OWN_MINUTES if own else _MINUTES)
    return given


def main() -> int:
    """Trace, draw, train and report; return the exit code."""
    given = read_arguments()
    # Import late, because --help needs no torch.
    from training_loop import Plan, new_run, resumed, train  # noqa: PLC0415

    checkpoint = given.folder / "checkpoint.pt"
    scenes, samples = given.folder / "scenes", given.folder / "samples"
    cv2.setNumThreads(1)
    if (given.resume or given.report) and checkpoint.exists():
        run = resumed(checkpoint)
    else:
        from_weights = given.resume or given.report or given.own is not None
        run = new_run(0, given.output if from_weights else None)
    if given.own is not None:
        scenes.mkdir(parents=True, exist_ok=True)
        for path, scene in zip(
            (scenes / _OWN, scenes / _OWN_HELD_OUT),
            own_scenes(given.own, 1e-3 * given.needle_width_mm),
            strict=True,
        ):
            write_scene(path, scene)
        print_report(run.mean_net, scenes)
    if not given.report:
        most = {"drawn": given.drawn, "traced": given.drawn}
        process = multiprocessing.get_context("spawn").Process(
            target=supply, args=(scenes, samples, most), daemon=True
        )
        process.start()
        try:
            if given.own is None:
                trace_all(given.scenes, scenes)
            wait_for_samples(samples, min(given.drawn, 40), process)
            train(run, Pool(samples), Plan(given.steps, given.minutes, given.output, checkpoint))
        finally:
            process.terminate()
            process.join()
        print(f"written: {given.output}")
    print_report(run.mean_net, scenes)
    return 0


def print_report(net: NeedleNet, scenes: Path) -> None:
    """Print the figures of a net on the held-out scenes in a folder."""
    from training_net import export  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "needle_net.onnx")
        export(net, path)
        weights = path.read_bytes()
    held_out = (read_scene(path) for path in scene_paths(scenes, held_out=True))
    print(f"images of scenes that it was not trained on\n{report(weights, held_out)}")


if __name__ == "__main__":
    sys.exit(run_command(main))
