"""Samples in files: functions that write them, and the pool from which the training draws."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.patches import patch
from needle_bringup.training.samples import BORDER, CANVAS, SIZE, Sample
from needle_bringup.training.traced_patches import traced_patch
from needle_bringup.training.traced_scenes import TracedScene
from needle_tracker.detector.needle_net import normalized

Float = NDArray[np.float32]

SHARD = 128
"""Number of samples in a file."""
CONTEXT = 8
"""Margin around a patch in the net's input [px], so that fewer pixels are at a border."""
KINDS = ("drawn", "traced")
_TRACED_SHARE = 0.6  # share of path-traced samples in a batch
_OUTSIDE = BORDER - CONTEXT
HELD_OUT = 9
"""Last digit of the numbers of scenes that are for the report only."""
_AT_ONCE = 12  # number of scenes for the samples of one file
_TRACED_PER_DRAWN = 2
_SEED_OF = {"drawn": 0, "traced": 1}
_POLL = 5.0  # [s]


@dataclasses.dataclass(frozen=True, eq=False)
class Shard:
    """Samples of one file as arrays; an unknown background is 0."""

    images: NDArray[np.uint8]
    backgrounds: NDArray[np.uint8]
    known: NDArray[np.bool_]
    shares: NDArray[np.uint8]
    ends: NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Batch:
    """Inputs of the net, and the labels.

    Attributes
    ----------
    inputs : ndarray of float32, shape (n, 2, SIZE + 2 CONTEXT, SIZE + 2 CONTEXT)
        Images and backgrounds, normalized.
    shares : ndarray of float32, shape (n, SIZE, SIZE)
        Share of the shaft in each pixel, 0 to 1.
    ends : ndarray of float32, shape (n, 2)
        Column and row of the end in each patch [px]; NaN if there is none.
    """

    inputs: Float
    shares: Float
    ends: Float


def write_shard(path: Path, seed: list[int], draw: Callable[[np.random.Generator], Sample]) -> None:
    """Write a file of samples, atomically.

    Parameters
    ----------
    path : Path
        The file.
    seed : list of int
        Seed of the generator of each sample.
    draw : callable
        Returns a sample.
    """
    drawn = [draw(np.random.default_rng([*seed, i])) for i in range(SHARD)]
    empty = np.zeros((CANVAS, CANVAS), np.uint8)
    new = path.with_suffix(".new")
    with new.open("wb") as file:
        np.savez(
            file,
            images=np.stack([each.image for each in drawn]),
            backgrounds=np.stack(
                [empty if each.background is None else each.background for each in drawn]
            ),
            known=np.array([each.background is not None for each in drawn]),
            shares=np.stack([each.share for each in drawn]),
            ends=np.stack([each.end for each in drawn]),
        )
    new.replace(path)


def read_shard(path: Path) -> Shard:
    """Return the samples of a file."""
    with np.load(path) as content:
        return Shard(**content)


class Pool:
    """All samples in the files `drawn-*.npz` and `traced-*.npz` of a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._shards: dict[str, dict[str, Shard]] = {kind: {} for kind in KINDS}

    def update(self) -> int:
        """Read new files and drop deleted ones; return the number of samples."""
        for kind, shards in self._shards.items():
            there = {path.name: path for path in self._folder.glob(f"{kind}-*.npz")}
            for name in shards.keys() - there.keys():
                del shards[name]
            for name in sorted(there.keys() - shards.keys()):
                # The other process may delete the file in the meantime.
                with contextlib.suppress(FileNotFoundError):
                    shards[name] = read_shard(there[name])
        return SHARD * sum(len(shards) for shards in self._shards.values())

    def batch(self, rng: np.random.Generator, count: int) -> Batch:
        """Return random samples of both kinds, randomly rotated and mirrored.

        Parameters
        ----------
        rng : Generator
            Random generator.
        count : int
            Number of samples.
        """
        traced = round(_TRACED_SHARE * count)
        kinds = [KINDS[1]] * traced + [KINDS[0]] * (count - traced)
        chosen = []
        for kind in kinds:
            shards = list((self._shards[kind] or self._shards[KINDS[0]]).values())
            chosen.append((shards[rng.integers(len(shards))], int(rng.integers(SHARD))))
        turns, mirrors = rng.integers(4, size=count), rng.random(count) < 0.5
        return batch_of(chosen, [int(n) for n in turns], [bool(m) for m in mirrors])


def batch_of(chosen: list[tuple[Shard, int]], turns: list[int], mirrors: list[bool]) -> Batch:
    """Return selected samples as a batch.

    Parameters
    ----------
    chosen : list of tuple
        Files, and indices in them.
    turns : list of int
        Quarter turns of each sample.
    mirrors : list of bool
        Whether each sample is mirrored after that.
    """
    side = SIZE + 2 * CONTEXT
    inputs = np.zeros((len(chosen), 2, side, side), np.float32)
    shares = np.empty((len(chosen), SIZE, SIZE), np.float32)
    ends = np.full((len(chosen), 2), np.nan, np.float32)
    inner, shown = slice(BORDER, -BORDER), slice(_OUTSIDE, -_OUTSIDE)
    for k, ((shard, i), turn, mirror) in enumerate(zip(chosen, turns, mirrors, strict=True)):
        flip = -1 if mirror else 1
        images = [shard.images[i]] + [shard.backgrounds[i]] * bool(shard.known[i])
        for channel, image in enumerate(images):
            inputs[k, channel] = np.rot90(normalized(image)[shown, shown], turn)[::flip]
        shares[k] = np.rot90(shard.shares[i][inner, inner], turn)[::flip]
        ends[k] = _turned(shard.ends[i] - BORDER, turn, mirror)
    outside = ~((ends >= 0.0) & (ends <= SIZE - 1.0)).all(axis=1)
    ends[outside] = np.nan
    return Batch(inputs, shares / np.float32(255.0), ends)


def _turned(end: NDArray[np.float64], turn: int, mirror: bool) -> NDArray[np.float64]:
    """Return a point of a patch that was rotated and mirrored [px]."""
    x, y = end
    for _ in range(turn):
        x, y = y, SIZE - 1.0 - x
    return np.array([x, SIZE - 1.0 - y if mirror else y])


# ---- supply -------------------------------------------------------------------------------------


def is_held_out(seed: int) -> bool:
    """Return whether a scene is for the report only."""
    return seed % 10 == HELD_OUT


def read_scene(path: Path) -> TracedScene:
    """Return a stored scene."""
    with np.load(path) as content:
        return TracedScene(**content)


def write_scene(path: Path, scene: TracedScene) -> None:
    """Write a scene, atomically."""
    new = path.with_suffix(".new")
    with new.open("wb") as file:
        np.savez(file, **{f.name: getattr(scene, f.name) for f in dataclasses.fields(scene)})
    new.replace(path)


def scene_paths(folder: Path, held_out: bool) -> list[Path]:
    """Return the files of the scenes in a folder, sorted by number."""
    paths = [path for path in folder.glob("*.npz") if path.stem.isdigit()]
    paths = [path for path in paths if is_held_out(int(path.stem)) == held_out]
    return sorted(paths, key=lambda path: int(path.stem))


def supply(scenes: Path, folder: Path, most: dict[str, int]) -> None:
    """Write files of samples forever; above the limit, a new traced file replaces the oldest.

    Parameters
    ----------
    scenes : Path
        Folder of the scenes, which may grow.
    folder : Path
        Output folder.
    most : dict of str to int
        Maximum number of files of each kind; drawing stops there.
    """
    cv2.setNumThreads(1)
    folder.mkdir(parents=True, exist_ok=True)
    for _ in count():
        if len(list(folder.glob("drawn-*.npz"))) < most["drawn"]:
            write_shard(*_next(folder, "drawn"), patch)
        known = scene_paths(scenes, held_out=False)
        for _ in range(_TRACED_PER_DRAWN if known else 0):
            path, seed = _next(folder, "traced")
            chosen = np.random.default_rng(seed).permutation(len(known))[:_AT_ONCE]
            cut_from = [read_scene(known[i]) for i in chosen]
            write_shard(path, seed, partial(traced_patch, scenes=cut_from))
            for old in sorted(folder.glob("traced-*.npz"))[: -most["traced"]]:
                old.unlink()
        if not known:
            time.sleep(_POLL)


def _next(folder: Path, kind: str) -> tuple[Path, list[int]]:
    """Return the next file of a kind, and its seed."""
    paths = sorted(folder.glob(f"{kind}-*.npz"))
    number = int(paths[-1].stem.rpartition("-")[2]) + 1 if paths else 0
    return folder / f"{kind}-{number:05d}.npz", [_SEED_OF[kind], number]
