"""Figures of a trained net on samples of held-out scenes."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from needle_bringup.training.samples import exposed
from needle_bringup.training.traced_scenes import TracedScene
from needle_tracker.detector import needle_net
from needle_tracker.detector.needle_net import normalized
from sample_pool import CONTEXT, SHARD, Shard, batch_of
from training_net import NeedleNet, StoredNet, export

Array = NDArray[np.float64]

WIDTHS_PX = (2.2, 4.0, 6.0, 9.0)
"""Bounds of the classes of needle widths [px]."""
_NEAR_PX = 4  # maximum error of a detected end
_AROUND_PX = 8  # radius of one peak
_SEEN = 0.5  # expected number of ends from which a peak counts as a detection
_SHAFT_PX = 15.0  # length of shaft that determines its direction
_AT_ONCE = 16  # samples in a batch


@dataclasses.dataclass(frozen=True)
class EndError:
    """Error of one detected end.

    Attributes
    ----------
    along, across : float
        Error along and across the shaft [px].
    sigmas : float
        Mahalanobis distance with respect to the spread of the peak.
    """

    along: float
    across: float
    sigmas: float


@dataclasses.dataclass
class Figures:
    """Figures over all samples of one class."""

    samples: int = 0
    entropy: float = 0.0
    end_loss: float = 0.0
    ends: int = 0
    empty: int = 0
    false_peaks: int = 0
    errors: list[EndError] = dataclasses.field(default_factory=list)

    def line(self) -> str:
        """Return a line of the table."""
        errors = self.errors or [EndError(np.nan, np.nan, np.nan)]
        along = [abs(error.along) for error in errors]
        across = [abs(error.across) for error in errors]
        within = np.mean([error.sigmas < 2.0 for error in errors])
        return (
            f"{self.samples:5d} {self.entropy / max(self.samples, 1):7.4f} "
            f"{self.end_loss / max(self.samples, 1):6.2f} "
            f"{self.ends:5d} {len(self.errors) / max(self.ends, 1):6.1%} "
            f"{np.median(along):6.2f} {np.median(across):6.2f} {within:6.1%} "
            f"{self.empty:5d} {self.false_peaks / max(self.empty, 1):7.3f}"
        )


HEADER = (
    "width px  background   n  shaft BCE  end NLL ends  seen  along across 2sigma empty false/patch"
)


def discs(intensity: Array) -> Array:
    """Return the expected number of ends within `_NEAR_PX` of each pixel."""
    reach = np.arange(-_NEAR_PX, _NEAR_PX + 1)
    disc = (np.hypot(*np.meshgrid(reach, reach)) <= _NEAR_PX).astype(np.float64)
    return np.asarray(cv2.filter2D(intensity, -1, disc, borderType=cv2.BORDER_CONSTANT))


def peaks(intensity: Array) -> NDArray[np.int64]:
    """Return the detected ends, column and row, shape (n, 2)."""
    expected = discs(intensity)
    side = 2 * _AROUND_PX + 1
    highest = cv2.dilate(expected, np.ones((side, side), np.uint8))
    rows, columns = np.nonzero((expected == highest) & (expected > _SEEN))
    return np.stack([columns, rows], axis=1)


def end_error(intensity: Array, share: Array, end: Array) -> EndError | None:
    """Return the error of a detected end; None if it was not detected.

    Parameters
    ----------
    intensity : ndarray, shape (height, width)
        Intensity of ends [1/px^2].
    share : ndarray, shape (height, width)
        Share of the shaft in each pixel.
    end : ndarray, shape (2,)
        True end, column and row [px].
    """
    rows, columns = np.indices(intensity.shape)
    pixels = np.stack([columns, rows], axis=-1)
    away = np.hypot(*np.moveaxis(pixels - end, -1, 0))
    if intensity[away <= _NEAR_PX].sum() <= _SEEN:
        return None
    shaft = (share > 0.5) & (away < _SHAFT_PX)
    ahead = end - pixels[shaft].mean(axis=0) if shaft.any() else np.array([1.0, 0.0])
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    near = away <= _AROUND_PX
    weights, around = intensity[near], pixels[near].astype(np.float64)
    centre = weights @ around / weights.sum()
    spread = (weights * (around - centre).T) @ (around - centre) / weights.sum()
    error = centre - end
    sigmas = float(np.sqrt(error @ np.linalg.solve(spread + 1e-3 * np.eye(2), error)))
    return EndError(float(error @ ahead), float(error @ [-ahead[1], ahead[0]]), sigmas)


def report(net: NeedleNet, shards: Iterable[Shard]) -> str:
    """Return a table of the figures of a net, by needle width and presence of a background."""
    stored = StoredNet(net).eval()
    table: dict[tuple[int, bool], Figures] = {}
    for shard in shards:
        for first in range(0, SHARD, _AT_ONCE):
            chosen = [(shard, i) for i in range(first, first + _AT_ONCE)]
            batch = batch_of(chosen, [0] * _AT_ONCE, [False] * _AT_ONCE)
            with torch.no_grad():
                shaft, log_intensity = (
                    each.numpy()[:, 0, CONTEXT:-CONTEXT, CONTEXT:-CONTEXT].astype(np.float64)
                    for each in stored(torch.from_numpy(batch.inputs))
                )
            for k in range(_AT_ONCE):
                width = int(np.searchsorted(WIDTHS_PX[1:-1], batch.widths_px[k]))
                figures = table.setdefault((width, bool(batch.known[k])), Figures())
                share, end = batch.shares[k].astype(np.float64), batch.ends[k].astype(np.float64)
                _count(figures, shaft[k], log_intensity[k], share, end)
    lines = [HEADER]
    for (width, known), figures in sorted(table.items()):
        name = f"{WIDTHS_PX[width]:.1f}-{WIDTHS_PX[width + 1]:.1f}  {'yes' if known else 'no ':3s}"
        lines.append(f"{name}  {figures.line()}")
    return "\n".join(lines)


def _count(figures: Figures, shaft: Array, log_intensity: Array, share: Array, end: Array) -> None:
    """Add one sample to the figures."""
    chance = np.clip(shaft, 1e-6, 1.0 - 1e-6)
    intensity = np.exp(log_intensity)
    figures.samples += 1
    figures.entropy -= float(np.mean(share * np.log(chance) + (1 - share) * np.log(1 - chance)))
    figures.end_loss += float(intensity.sum())
    if np.isfinite(end).all():
        figures.ends += 1
        pixel = np.asarray([[end]], np.float32)
        at_end = cv2.remap(intensity, pixel, None, cv2.INTER_LINEAR)
        figures.end_loss -= float(np.log(max(float(np.ravel(at_end)[0]), 1e-9)))
        error = end_error(intensity, share, end)
        if error is not None:
            figures.errors.append(error)
    else:
        figures.empty += 1
        figures.false_peaks += len(peaks(intensity))


def report_views(net: NeedleNet, scenes: Iterable[TracedScene]) -> str:
    """Return a table of the ends detected in whole images, without and with a background.

    Parameters
    ----------
    net : NeedleNet
        The net.
    scenes : iterable of TracedScene
        Held-out scenes.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "needle_net.onnx")
        export(net, path)
        detector = needle_net.NeedleNet(path.read_bytes())
    found_ends, wrong, false = np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2))
    for number, scene in enumerate(scenes):
        for i in range(len(scene.images)):
            for known in (False, True):
                rng = np.random.default_rng([number, i])
                empty = scene.images[i % 2].astype(np.float32)
                image, background = exposed(
                    rng, scene.images[i].astype(np.float32), empty if known else None
                )
                _, intensity = detector.evidence(
                    normalized(image), None if background is None else normalized(background)
                )
                found = peaks(intensity.astype(np.float64))
                if i < 2:
                    false[int(known)] += [1, len(found)]
                elif np.isfinite(scene.ends[i]).all():
                    away = np.hypot(*(found - scene.ends[i]).T)
                    found_ends[int(known)] += [1, (away < _AROUND_PX).any()]
                    wrong[int(known)] += (away >= _AROUND_PX).sum()
    lines = ["background  ends  seen  others/image  empty  false/image"]
    for row, name in enumerate(("no", "yes")):
        ends, empty = found_ends[row, 0], false[row, 0]
        lines.append(
            f"{name:10s}  {ends:4.0f} {found_ends[row, 1] / max(ends, 1):5.1%}  "
            f"{wrong[row] / max(ends, 1):8.2f}  {empty:9.0f} {false[row, 1] / max(empty, 1):8.2f}"
        )
    return "\n".join(lines)
