"""Files of samples: training samples from a background process, and validation samples."""

from __future__ import annotations

import dataclasses
import time
from functools import partial
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from needle_bringup.training.patches import patch
from needle_bringup.training.traced_patches import traced_patch
from needle_bringup.training.traced_scenes import TracedScene
from sample_pool import write_shard

HELD_OUT = 9
"""Scenes whose number ends with this digit are for validation only."""
_AT_ONCE = 12  # scenes for the samples of one file
_TRACED_PER_DRAWN = 2
_VALIDATION = 6  # files of each kind
_SEED_OF, _UNSEEN = {"drawn": 0, "traced": 1}, 10
_POLL = 5.0  # [s]


def is_held_out(seed: int) -> bool:
    """Return whether a scene is for validation only."""
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
    """Return the files of the scenes in a folder, by their number."""
    paths = [path for path in folder.glob("*.npz") if path.stem.isdigit()]
    paths = [path for path in paths if is_held_out(int(path.stem)) == held_out]
    return sorted(paths, key=lambda path: int(path.stem))


def supply(scenes: Path, folder: Path, most: dict[str, int]) -> None:
    """Write files of samples without end: above the limit, a new file replaces the oldest.

    Parameters
    ----------
    scenes : Path
        Folder of the scenes, which may grow.
    folder : Path
        Output folder.
    most : dict of str to int
        Largest number of files of each kind; drawing stops there.
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


def write_validation(scenes: Path, folder: Path) -> None:
    """Write the missing files of validation samples.

    Parameters
    ----------
    scenes : Path
        Folder of the scenes.
    folder : Path
        Output folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    held_out = [read_scene(path) for path in scene_paths(scenes, held_out=True)]
    draws = {"drawn": patch}
    if held_out:
        draws["traced"] = partial(traced_patch, scenes=held_out)
    for kind, draw in draws.items():
        for number in range(_VALIDATION):
            path = folder / f"{kind}-{number:05d}.npz"
            if not path.exists():
                write_shard(path, [_SEED_OF[kind] + _UNSEEN, number], draw)


def _next(folder: Path, kind: str) -> tuple[Path, list[int]]:
    """Return the next file of a kind, and its seed."""
    paths = sorted(folder.glob(f"{kind}-*.npz"))
    number = int(paths[-1].stem.rpartition("-")[2]) + 1 if paths else 0
    return folder / f"{kind}-{number:05d}.npz", [_SEED_OF[kind], number]
