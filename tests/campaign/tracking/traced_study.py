"""The tracker over path-traced insertions: metal needles under lamps, over floors of all kinds."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from campaign.tracking.traced_set import DrawnSequence, TracedScene
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.stereo.triangulation import SpatialTip
from needle_tracker.tracker_parameters import StereoTrackerParameters

Image = NDArray[np.uint8]
_NOISE = 12.0  # grey levels
_QUALITY = 20  # of JPEG
_GAIN = 0.4


@dataclasses.dataclass(frozen=True)
class Variation:
    """One wrong parameter or degradation of the images.

    Attributes
    ----------
    name : str
        Description.
    width : float
        Given needle width relative to the true one.
    zero : float
        Error of the given insertion [m].
    degrade : callable
        Function from image and random generator to image.
    """

    name: str
    width: float = 1.0
    zero: float = 0.0
    degrade: Callable[[Image, np.random.Generator], Image] = lambda image, _: image


def _blurred(sigma: float) -> Callable[[Image, np.random.Generator], Image]:
    return lambda image, _: np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def _coded(image: Image, _: np.random.Generator) -> Image:
    code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)


def _noisy(image: Image, rng: np.random.Generator) -> Image:
    values = image + rng.normal(0.0, _NOISE, image.shape)
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0), np.uint8)


def _dim(image: Image, _: np.random.Generator) -> Image:
    return np.asarray(np.rint(_GAIN * image), np.uint8)


AS_TRACED = Variation("as traced")
VARIATIONS = (
    Variation("width set 0.7 times", width=0.7),
    Variation("width set 1.3 times", width=1.3),
    Variation("stage 1 mm too long", zero=1e-3),
    Variation("stage 1 mm too short", zero=-1e-3),
    Variation("blur of 1 px", degrade=_blurred(1.0)),
    Variation("blur of 2 px", degrade=_blurred(2.0)),
    Variation("JPEG 20", degrade=_coded),
    Variation("noise 12", degrade=_noisy),
    Variation("gain 0.4", degrade=_dim),
)


class KnownInput(enum.Enum):
    """Inputs of the tracker besides the pairs of a sequence."""

    NOTHING = "without"
    INSERTION = "with"
    EMPTY_PHANTOM = (
        "with the empty phantom and the"  # as on a rig, where a run starts with the needle outside
    )


@dataclasses.dataclass(frozen=True, eq=False)
class TrackedPair:
    """The tracker's answer to a path-traced pair.

    Attributes
    ----------
    scene : TracedScene
        Scene of the pair.
    known : KnownInput
        Further inputs of the tracker.
    tip : SpatialTip or None
        Reported tip.
    truth : ndarray, shape (3,), or None
        The end of the shaft's axis in `rig` [m]; None where there is no needle.
    """

    scene: TracedScene
    known: KnownInput
    tip: SpatialTip | None
    truth: NDArray[np.float64] | None

    @property
    def error(self) -> float:
        """Distance of the tip from the truth [m]."""
        return float(np.linalg.norm(self._off))

    @property
    def normalized(self) -> float:
        """Squared error over its covariance."""
        assert self.tip is not None
        return float(self._off @ np.linalg.solve(self.tip.covariance, self._off))

    @property
    def _off(self) -> NDArray[np.float64]:
        assert self.tip is not None
        assert self.truth is not None
        return np.asarray(self.tip.position - self.truth)


def tracked_pairs(
    sequence: DrawnSequence, known: KnownInput, variation: Variation = AS_TRACED
) -> Iterator[TrackedPair]:
    """Yield the tracker's results for the pairs of a sequence.

    Pairs without all of a needle's last 10 mm in both images are processed and not yielded.

    Parameters
    ----------
    sequence : DrawnSequence
        The pairs.
    known : KnownInput
        Further inputs of the tracker.
    variation : Variation
        Wrong parameter or degradation.
    """
    rng = np.random.default_rng(sequence.scene.seed)
    stereo = load_calibration(sequence.calibration)
    left, right = (variation.degrade(image, rng) for image in sequence.empty)
    tracker = NeedleTracker(
        stereo,
        StereoTrackerParameters(needle_width=variation.width * sequence.scene.look.diameter),
        (left, right) if known is KnownInput.EMPTY_PHANTOM else None,
    )
    for number, pair in enumerate(sequence.pairs):
        left, right = (variation.degrade(image, rng) for image in pair)
        insertion = float(sequence.insertions[number]) + variation.zero
        tip = tracker.process(left, right, None if known is KnownInput.NOTHING else insertion).tip
        if not sequence.scene.look.needle:
            yield TrackedPair(sequence.scene, known, tip, None)
        elif sequence.seen[number].min() >= 1.0:
            yield TrackedPair(sequence.scene, known, tip, sequence.tips[number])
