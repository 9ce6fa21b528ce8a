"""Figures of a net on whole images of held-out scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.samples import exposed
from needle_bringup.training.traced_scenes import TracedScene
from needle_tracker.detector.needle_net import NeedleNet, normalized

Array = NDArray[np.float64]

WIDTHS_PX = (0.0, 4.0, 6.0, np.inf)
"""Bounds of the classes of needle widths [px]."""
_NEAR_PX = 4  # maximum error of a detected end
_AROUND_PX = 8  # radius of one peak
_SEEN = 0.5  # expected number of ends from which a peak counts as a detection
_SHAFT_PX = 15.0  # length of shaft that determines its direction
HEADER = "width px  background  ends  seen   along across 2sigma  others/image  empty  false/image"


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
    """Figures over all images of one class, with and without a needle's end."""

    ends: int = 0
    others: int = 0
    empty: int = 0
    false_peaks: int = 0
    errors: list[EndError] = dataclasses.field(default_factory=list)

    def count(self, intensity: Array, share: Array, end: Array) -> None:
        """Add an image; the arrays are those of `end_error`."""
        found = peaks(intensity)
        if not share.any():
            self.empty += 1
            self.false_peaks += len(found)
        elif np.isfinite(end).all():
            self.ends += 1
            self.others += int((np.hypot(*(found - end).T) >= _AROUND_PX).sum())
            error = end_error(intensity, share, end)
            self.errors += [] if error is None else [error]

    def line(self) -> str:
        """Return a line of the table."""
        errors = self.errors or [EndError(np.nan, np.nan, np.nan)]
        along = [abs(error.along) for error in errors]
        across = [abs(error.across) for error in errors]
        within = np.mean([error.sigmas < 2.0 for error in errors])
        ends, empty = max(self.ends, 1), max(self.empty, 1)
        return (
            f"{self.ends:4d} {len(self.errors) / ends:6.1%} "
            f"{np.median(along):6.2f} {np.median(across):6.2f} {within:6.1%} "
            f"{self.others / ends:13.2f} {self.empty:6d} {self.false_peaks / empty:12.2f}"
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


def report(weights: bytes, scenes: Iterable[TracedScene]) -> str:
    """Return a table of the detected ends, by needle width and presence of a background.

    Parameters
    ----------
    weights : bytes
        The net as ONNX.
    scenes : iterable of TracedScene
        Held-out scenes.
    """
    net = NeedleNet(weights)
    table: dict[tuple[int, bool], Figures] = {}
    for number, scene in enumerate(scenes):
        for i, image in enumerate(scene.images):
            for known in (False, True):
                rng = np.random.default_rng([number, i])
                empty = scene.images[i % 2].astype(np.float32) if known else None
                photo, background = exposed(rng, image.astype(np.float32), empty)
                _, intensity = net.evidence(
                    normalized(photo), None if background is None else normalized(background)
                )
                width = int(np.digitize(scene.widths_px[i], WIDTHS_PX))
                figures = table.setdefault((width, known), Figures())
                share = scene.shares[i] / 255.0
                figures.count(intensity.astype(np.float64), share, scene.ends[i])
    lines = [HEADER]
    for (width, known), figures in sorted(table.items()):
        name = f"{WIDTHS_PX[width - 1]:.0f} to {WIDTHS_PX[width]:.0f}"
        lines.append(f"{name:8s}  {'yes' if known else 'no':10s}  {figures.line()}")
    return "\n".join(lines)
