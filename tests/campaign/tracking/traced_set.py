"""`python -m campaign.tracking.traced_set`: renders the path-traced pairs of `scripts/verify C`.

One half of the set is for development; the other half is held back for `scripts/verify C`. Existing
sequences are kept, so that an interrupted run can be continued.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.commands.options import CommandParser
from needle_core.files.installed import find_shared_file
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.appearance import Appearance, draw_appearance
from needle_sim.path_traced.insertion import trace_insertion
from needle_sim.path_traced.tracer import load_mitsuba
from needle_sim.sequences.boxes import draw_box

RIGS = ("bench", "top_and_side", "webcams")
PAIRS = 6
NEEDLES, ABSENT = 51, 21
"""Number of sequences per half, with and without a needle; the rigs alternate."""
LOOKED_AT, HELD_BACK = 30_000, 40_000
"""First seed of each half."""
_STEP = 1e-3
_BEGIN = (0.02, 0.085)  # insertion of the first pair; webcams see less of the path [m]
_BEGIN_WEBCAMS = (0.015, 0.05)
_STREAM = 23


@dataclasses.dataclass(frozen=True)
class TracedScene:
    """Name of a sequence, which determines its content.

    Attributes
    ----------
    rig : str
        One of `RIGS`.
    appearance : str
        Name for `draw_appearance`.
    seed : int
        Seed of appearance, path, noise and box.
    """

    rig: str
    appearance: str
    seed: int

    @property
    def look(self) -> Appearance:
        """Metal, lamps, floor and dirt."""
        return draw_appearance(self.appearance, self.seed)

    @property
    def name(self) -> str:
        """Stem of its files."""
        return f"{self.rig}_{self.appearance}_{self.seed}"


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnSequence:
    """Images of a scene, and the truth.

    Attributes
    ----------
    scene : TracedScene
        Scene of the images.
    calibration : Path
        Calibration file of the cameras.
    empty, pairs : ndarray of uint8, shape (2, height, width), (N, 2, height, width)
        Left and right images without and with the needle.
    insertions : ndarray, shape (N,)
        Insertions of the stage [m].
    tips : ndarray, shape (N, 3)
        The end of the shaft's axis in `rig` [m]; NaN where there is no needle.
    seen : ndarray, shape (N, 2)
        Share of the needle's last 10 mm in each camera's image.
    """

    scene: TracedScene
    calibration: Path
    empty: NDArray[np.uint8]
    pairs: NDArray[np.uint8]
    insertions: NDArray[np.float64]
    tips: NDArray[np.float64]
    seen: NDArray[np.float64]


def scenes(first_seed: int) -> list[TracedScene]:
    """Return the sequences of a half, those without a needle among the others."""
    found = []
    for number in range(NEEDLES):
        found.append(TracedScene(RIGS[number % 3], "random", first_seed + number))
        if number % 5 in (1, 3) and number // 5 * 2 < ABSENT:
            at = len([scene for scene in found if scene.appearance == "absent"])
            found.append(TracedScene(RIGS[at % 3], "absent", first_seed + 1000 + at))
    return found


def drawn(folder: Path, wanted: Sequence[TracedScene]) -> Iterator[DrawnSequence]:
    """Yield stored sequences, and trace missing ones.

    Parameters
    ----------
    folder : Path
        Folder of the sequences.
    wanted : sequence of TracedScene
        Requested sequences.

    Raises
    ------
    UserError
        If one has to be traced and the path tracer is not installed.
    """
    folder.mkdir(exist_ok=True)
    for scene in wanted:
        kept = folder / f"{scene.name}.npz"
        calibration = _calibration(folder, scene)
        if not kept.is_file():
            partial = kept.with_suffix(".part.npz")
            np.savez_compressed(partial, allow_pickle=False, **_traced(calibration, scene))
            partial.rename(kept)
        with np.load(kept) as arrays:
            yield DrawnSequence(scene, calibration, **arrays)


def _calibration(folder: Path, scene: TracedScene) -> Path:
    if scene.rig == "webcams":
        path = folder / f"{scene.name}.yaml"
        path.write_text(draw_box(scene.seed), encoding="utf-8")
        return path
    name = {"bench": "calibration.yaml", "top_and_side": "calibration_top_and_side.yaml"}
    return find_shared_file("needle_tracker", f"config/{name[scene.rig]}")


def _traced(calibration: Path, scene: TracedScene) -> dict[str, NDArray[np.generic]]:
    mitsuba, rig, look = load_mitsuba(), load_stereo_rig(calibration), scene.look
    bounds = _BEGIN_WEBCAMS if scene.rig == "webcams" else _BEGIN
    begin = float(np.random.default_rng([scene.seed, _STREAM]).uniform(*bounds))
    depth = begin + (PAIRS - 1) * _STEP
    empty, *pairs = trace_insertion(
        mitsuba, rig, look, frames=PAIRS, depth=depth, begin=begin, empty_first=True
    )
    nowhere = np.full(3, np.nan)
    return {
        "empty": np.stack(empty.images),
        "pairs": np.stack([np.stack(pair.images) for pair in pairs]),
        "insertions": np.array([pair.insertion for pair in pairs]),
        "tips": np.stack([nowhere if pair.truth is None else pair.truth.tip for pair in pairs]),
        "seen": np.array([pair.visible_share for pair in pairs]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the set, or one half of it; returns the exit code."""
    parser = CommandParser("traced_set", str(__doc__), "")
    parser.add_argument("folder", metavar="DIR", help="folder; existing sequences are kept")
    parser.add_argument("--held-back", action="store_true", help="only the half that is held back")
    given = parser.parse_args(arguments)
    wanted = scenes(HELD_BACK) + ([] if given.held_back else scenes(LOOKED_AT))

    def draw() -> int:
        sequences = drawn(Path(given.folder).expanduser(), wanted)
        for _ in tqdm(sequences, total=len(wanted), disable=not sys.stderr.isatty()):
            pass
        return EXIT_DONE

    return run_command(draw)


if __name__ == "__main__":
    sys.exit(main())
