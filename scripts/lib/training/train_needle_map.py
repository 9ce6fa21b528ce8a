"""Train the net that draws needle maps; scripts/train_needle_map runs this.

Patches are drawn at random, or cut from scenes that are path-traced at random, by
needle_bringup.training. What comes out depends a little on the machine: another run gives
another net, about as good.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional
from tqdm import tqdm

from needle_bringup.training.patches import SIZE, patch
from needle_bringup.training.traced_patches import BORDER, traced_patch
from needle_bringup.training.traced_scenes import TracedScene, trace_scene
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_sim.path_traced.tracer import load_mitsuba
from needle_sim.sequences.boxes import draw_box
from needle_tracker.image.needle_map import normalized

Batch = tuple[NDArray[Any], NDArray[Any]]

TRACKER = Path(__file__).parents[3] / "ros2_ws/src/needle_tracker"
WEIGHTS = TRACKER / "needle_tracker/image/needle_map.onnx"
CALIBRATIONS = (
    TRACKER / "config/calibration.yaml",
    TRACKER / "config/calibration_top_and_side.yaml",
)
_CHANNELS, _FINE_CHANNELS = 16, 8
_DILATIONS = (1, 2, 4, 8, 4, 2, 1)
_SHARD = 256
_TRACED_SHARE = 0.6  # of a batch
_BATCH, _RATE, _DECAY = 16, 3e-3, 1e-4
_RATE_ON = 1e-3  # of a net that has learned before
_NEEDLE_WEIGHT = 4.0  # most pixels are floor


class NeedleNet(nn.Module):
    """A trunk at half the size that looks far around, and a head at full size for the edges."""

    def __init__(self) -> None:
        super().__init__()
        channels = _CHANNELS
        self.first = nn.Conv2d(1, channels, 5, 2, 2)
        self.trunk = nn.ModuleList(
            nn.Conv2d(channels, channels, 3, 1, dilation, dilation) for dilation in _DILATIONS
        )
        self.up = nn.Conv2d(channels, 4 * _FINE_CHANNELS, 1)
        self.fine = nn.Conv2d(1, _FINE_CHANNELS, 3, 1, 1)
        self.last = nn.Conv2d(2 * _FINE_CHANNELS, _FINE_CHANNELS, 3, 1, 1)
        self.out = nn.Conv2d(_FINE_CHANNELS, 1, 3, 1, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the logit of being needle for each pixel of `normalized` images, (n, 1, h, w)."""
        seen = functional.relu(self.first(image))
        for layer in self.trunk:
            seen = seen + functional.relu(layer(seen))
        wide = functional.relu(functional.pixel_shuffle(self.up(seen), 2))
        fine = functional.relu(self.fine(image))
        return self.out(functional.relu(self.last(torch.cat([wide, fine], 1))))


class NeedleMapNet(nn.Module):
    """The net with chances in place of logits: what is stored."""

    def __init__(self, net: NeedleNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the chance of being needle for each pixel, (n, 1, h, w)."""
        # Trained with that weight, the net takes the odds of needle for so many times too high.
        return torch.sigmoid(self.net(image) - math.log(1.0 + _NEEDLE_WEIGHT))


def draw_shard(number: int) -> Batch:
    """Return drawn patches as the net sees them, and 255 times the share that is needle."""
    drawn = [patch(np.random.default_rng([number, i])) for i in range(_SHARD)]
    seen = np.stack([normalized(image) for image, _ in drawn]).astype(np.float16)
    return seen, np.stack([np.rint(255.0 * share).astype(np.uint8) for _, share in drawn])


def draw_all(shards: int) -> Batch:
    """Return all drawn patches, by all cores."""
    with ProcessPoolExecutor() as pool:
        drawn = pool.map(draw_shard, range(shards))
        parts = list(tqdm(drawn, "drawing patches", shards, unit=f"x{_SHARD}"))
    return np.concatenate([seen for seen, _ in parts]), np.concatenate([y for _, y in parts])


def trace_all(count: int) -> list[TracedScene]:
    """Return path-traced scenes: on the bench, from above and beside, and in every other a box."""
    mitsuba = load_mitsuba()
    bar = tqdm(range(count), "tracing scenes", unit="scene")
    return [trace_scene(mitsuba, rig_of(seed), seed) for seed in bar]


def rig_of(seed: int) -> StereoRig:
    """Return the cameras of a scene."""
    if seed % 2 == 0:
        return load_stereo_rig(CALIBRATIONS[seed // 2 % 2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "box.yaml")
        path.write_text(draw_box(seed), encoding="utf-8")
        return load_stereo_rig(path)


def batch(rng: np.random.Generator, drawn: Batch, scenes: list[TracedScene]) -> Batch:
    """Return patches of both kinds, turned and mirrored at random, and 0 to 1 what is needle."""
    seen = np.empty((_BATCH, 1, SIZE, SIZE), np.float32)
    wanted = np.empty_like(seen)
    traced = round(_TRACED_SHARE * _BATCH)
    for k in range(_BATCH):
        if k < traced:
            image, share = traced_patch(rng, scenes[rng.integers(len(scenes))])
            one = normalized(image)[BORDER:-BORDER, BORDER:-BORDER]
        else:
            i = rng.integers(len(drawn[0]))
            one, share = drawn[0][i], drawn[1][i] / np.float32(255.0)
        turns, mirror = int(rng.integers(4)), int(rng.choice([-1, 1]))
        seen[k, 0] = np.rot90(one, turns)[::mirror]
        wanted[k, 0] = np.rot90(share, turns)[::mirror]
    return seen, wanted


def stored(weights: Path) -> dict[str, torch.Tensor]:
    """Return the numbers of a stored net, by their names in `NeedleNet`."""
    numbers = onnx.load(weights).graph.initializer
    return {
        number.name.partition(".")[2]: torch.tensor(onnx.numpy_helper.to_array(number))
        for number in numbers
    }


def train(
    drawn: Batch, scenes: list[TracedScene], steps: int, begin_with: Path | None
) -> NeedleNet:
    """Return a net trained on these, anew or from stored weights on."""
    torch.manual_seed(0)
    # More threads than that wait for each other longer than they work.
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    net: NeedleNet = NeedleNet().to(memory_format=torch.channels_last)
    rate = _RATE
    if begin_with is not None:
        net.load_state_dict(stored(begin_with))
        rate = _RATE_ON
    optimizer = torch.optim.AdamW(net.parameters(), rate, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    bar = tqdm(range(steps), "training", unit="step")
    mean = 0.0
    for step in bar:
        seen, wanted = batch(rng, drawn, scenes)
        target = torch.from_numpy(wanted)
        logits = net(torch.from_numpy(seen).to(memory_format=torch.channels_last))
        losses = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
        loss = (losses * (1.0 + _NEEDLE_WEIGHT * target)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        mean += (loss.item() - mean) / min(step + 1, 100)
        bar.set_postfix(loss=f"{mean:.4f}")
    return net


def main() -> int:
    """Train, and write the weights; returns the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/train_needle_map", description=__doc__)
    parser.add_argument("--steps", type=int, default=20000, metavar="N", help="default: 20000")
    parser.add_argument("--shards", type=int, default=72, metavar="N", help="x256; default: 72")
    parser.add_argument("--scenes", type=int, default=140, metavar="N", help="default: 140")
    parser.add_argument(
        "--begin-with", type=Path, metavar="FILE.onnx", help="learn on from these; default: anew"
    )
    parser.add_argument("--output", type=Path, default=WEIGHTS, metavar="FILE.onnx")
    given = parser.parse_args()
    drawn, scenes = draw_all(given.shards), trace_all(given.scenes)
    net = train(drawn, scenes, given.steps, given.begin_with).eval()
    size = {2: "height", 3: "width"}
    torch.onnx.export(
        NeedleMapNet(net),
        (torch.zeros(1, 1, SIZE, SIZE),),
        str(given.output),
        input_names=["image"],
        output_names=["map"],
        dynamic_axes={"image": size, "map": size},
        opset_version=17,
        dynamo=False,
    )
    print(f"written: {given.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
