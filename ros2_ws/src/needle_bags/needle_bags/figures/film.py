"""Film of the insertion: exposures with the needle, in camera images and in drawings."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from needle_bags.figures.figure_style import (
    GOAL_BAND,
    MM,
    TRUTH,
    draw_goal,
    png_size,
    save,
    stacked,
)
from needle_bags.reading.bag_images import SIDES, TOPICS, exposures, images_at
from needle_bags.reading.bag_reader import Run, Series, Stamps
from needle_bags.run.run_summary import GOAL, finite_tips, target_offset, target_point, true_r1
from needle_bags.run.shaft_trail import ShaftTrail
from needle_core.errors import UserError
from needle_core.files.yaml_files import load_yaml
from needle_tracker.optics.calibration import parse_calibration

Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Projection = Callable[[Floats], Floats]

MAX_BYTES = 30_000
"""Size limit of a camera image; a film of both cameras has at most 3.7 MB, 5 MB in base64."""
_LARGEST_PX = (480, 400)
# JPEG qualities, tried in this order.
_QUALITIES = (75, 60, 45, 30, 15, 5, 1)
_MAX_POINTS = 24
_MAX_COORDINATE_PX = 1e4
MAX_FRAMES = 61
"""One frame every 2 mm of 120 mm, and the start."""

READINGS = (
    "Insertion",
    "r1, true",
    "r1, estimated",
    "Pitch, estimated",
    "Roll, estimated",
    "Base turned",
)
"""Labels of the values shown with each frame."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    stamp : int
        Time of exposure, ROS clock [ns].
    shaft : (n, 3) float64
        Measured needle, from the entry point to the tip, in `rig` [m]; empty without a tip.
    needle : (m, 3) float64
        The true needle if the bag has it, otherwise the measured one.
    readings : tuple of str
        Values of `READINGS`, as text.
    """

    stamp: int
    shaft: Floats
    needle: Floats
    readings: tuple[str, ...]


def film_of(run: Run) -> list[Frame]:
    """Return the frames of a run's film, at most `MAX_FRAMES`.

    Each is an exposure of the cameras or, without images, of the simulated sensor. They are spaced
    by equal motion of the needle, so that a needle at rest takes up no frames.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    has_images = any(run.topics.get(run.namespace + topic) for topic in TOPICS)
    all_stamps = exposures(run) if has_images else run.tips.stamps
    stamps = all_stamps[_spread(run.insertion_at(all_stamps))]
    measured = _trails(run, run.tips, stamps)
    true = _trails(run, run.truth, stamps) if len(run.truth) else measured
    return [
        Frame(int(stamp), shaft, needle, texts)
        for stamp, shaft, needle, texts in zip(
            stamps, measured, true, _readings(run, stamps), strict=True
        )
    ]


def _spread(insertion: Floats) -> npt.NDArray[np.int64]:
    """Return indices that are spaced by equal motion of the needle, (N,)."""
    if len(insertion) <= MAX_FRAMES:
        return np.arange(len(insertion))
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(insertion)))])
    if not travel[-1] > 0.0:
        travel = np.arange(len(insertion), dtype=np.float64)
    spaced = np.linspace(0.0, travel[-1], MAX_FRAMES)
    return np.unique(np.searchsorted(travel, spaced - 1e-9 * travel[-1]).clip(max=len(travel) - 1))


def _trails(run: Run, series: Series, stamps: Stamps) -> list[Floats]:
    """Return the needle at each stamp, from the entry to the tip; (0, 3) without a tip."""
    insertions = run.insertion_at(series.stamps).tolist()
    requested = frozenset(stamps.tolist())
    trail = ShaftTrail()
    found: dict[int, Floats] = {}
    for stamp, insertion, row in zip(
        series.stamps.tolist(), insertions, series.values, strict=True
    ):
        position = row[:3]
        if not np.isfinite(position).all():
            continue
        trail.add(insertion, position)
        if stamp in requested:
            found[stamp] = trail.shaft(insertion, position)
    return [found.get(stamp, np.empty((0, 3))) for stamp in stamps.tolist()]


def _readings(run: Run, stamps: Stamps) -> list[tuple[str, ...]]:
    """Return the values shown with each exposure, as text."""
    insertion, rotation = run.joints_at(stamps).T
    columns = [
        (insertion * 1e3, "{:.1f} mm"),
        (_at(run.truth, true_r1(run), stamps) * 1e3, "{:+.2f} mm"),
        (np.degrees(rotation), "{:.0f} deg"),
    ]
    x, pitch, roll = (_at(run.reduced_state, v, stamps) for v in run.reduced_state.values.T)
    columns[2:2] = [
        (x * 1e3, "{:+.2f} mm"),
        (np.degrees(pitch), "{:+.1f} deg"),
        (np.degrees(roll), "{:+.0f} deg"),
    ]
    texts = [[form.format(v) if np.isfinite(v) else "-" for v in vs] for vs, form in columns]
    return list(zip(*texts, strict=True))


def _at(series: Series, values: Floats, stamps: Stamps) -> Floats:
    """Return the values of a series at these stamps, (N,); NaN where it has none."""
    found = np.full(len(stamps), np.nan)
    here, there = series.at(stamps)
    found[there] = values[here]
    return found


@dataclasses.dataclass(frozen=True)
class View:
    """Picture for all frames, or one per frame, with the needle drawn over it.

    Attributes
    ----------
    name : str
        Caption.
    size : tuple of int
        Width and height of the coordinates in `lines` [px].
    pictures : sequence of bytes
        A JPEG for each frame, empty if the bag has none; or one PNG for all frames.
    lines : sequence of (n, 2) float64
        The needle in each frame, from the entry point to the tip; empty if it is not drawn.
    """

    name: str
    size: tuple[int, int]
    pictures: Sequence[bytes]
    lines: Sequence[Floats]

    @property
    def is_chart(self) -> bool:
        """Whether there is one drawing for all frames."""
        return len(self.pictures) == 1 and self.pictures[0].startswith(b"\x89PNG")


def projections(run: Run) -> dict[str, Projection]:
    """Return the projections of both cameras; empty without a calibration."""
    # Imported late, because a run without images does not need this compiled code.
    from needle_tracker.optics.refraction import stereo_views  # noqa: PLC0415

    try:
        calibration = parse_calibration(load_yaml(run.calibration))
    except (UserError, ValueError):
        return {}
    views = stereo_views(calibration)
    return {side: view.project for side, view in zip(SIDES, views, strict=True)}


def camera_views(run: Run, frames: Sequence[Frame]) -> list[View]:
    """Return the camera views.

    Parameters
    ----------
    run : Run
        The run; its images are read.
    frames : sequence of Frame
        Frames of the film.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    pictures: dict[tuple[int, str], bytes] = {}
    sizes: dict[str, tuple[int, int]] = {}
    stamps = np.array([frame.stamp for frame in frames], np.int64)
    for index, side, image in images_at(run, stamps):
        pictures[index, side] = _small_jpeg(image)
        sizes.setdefault(side, (image.shape[1], image.shape[0]))
    projection_of = projections(run) if sizes else {}
    return [
        View(
            f"{side} camera",
            sizes[side],
            [pictures.get((index, side), b"") for index in range(len(frames))],
            [_pixels(projection_of.get(side), frame.shaft) for frame in frames],
        )
        for side in SIDES
        if side in sizes
    ]


def plan_views(run: Run, frames: Sequence[Frame]) -> list[View]:
    """Return drawings of needle and target from the side and from above."""
    names = {0: "from the side, with the target plane", 1: "from above"}
    return [_plan_view(run, frames, axis, name) for axis, name in names.items()]


def _plan_view(run: Run, frames: Sequence[Frame], axis: int, name: str) -> View:
    plane, point = target_offset(run), target_point(run)
    known = [run.truth.values[:, :3], finite_tips(run).values, np.zeros((1, 3))]
    if point is not None:
        known.append(point[None])
    elif axis == 0:
        known.append(np.array([[plane - GOAL, 0.0, 0.0], [plane + GOAL, 0.0, 0.0]]))
    points = np.concatenate(known) * MM
    with stacked(1, 2.5, top=0.12) as (figure, (axes,)):
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.06 * (high - low) + 0.2
        axes.set_xlim(low[2] - margin[2], high[2] + margin[2])
        axes.set_ylim(low[axis] - margin[axis], high[axis] + margin[axis])
        if point is not None:
            axes.plot(point[2] * MM, point[axis] * MM, "*", ms=13, color=GOAL_BAND)
        elif axis == 0:
            draw_goal(axes, plane)
        path = (run.truth if len(run.truth) else finite_tips(run)).values * MM
        axes.plot(path[:, 2], path[:, axis], color=TRUTH, lw=0.9, ls=(0, (2, 3)))
        axes.set(xlabel="z, insertion [mm]", ylabel=("x, up [mm]", "y, beside [mm]")[axis])
        buffer = io.BytesIO()
        save(figure, buffer)
        picture = buffer.getvalue()
    width, height = png_size(picture)

    def pixels(needle: Floats) -> Floats:
        at = axes.transData.transform(needle[:, [2, axis]] * MM) / figure.bbox.size
        return np.column_stack([at[:, 0] * width, (1.0 - at[:, 1]) * height])

    lines = [_pixels(pixels, frame.needle) for frame in frames]
    return View(name, (width, height), [picture], lines)


def _pixels(project: Projection | None, needle: Floats) -> Floats:
    """Return the pixels of at most `_MAX_POINTS` points of a needle, (n, 2)."""
    if project is None or not len(needle):
        return np.empty((0, 2))
    chosen = np.unique(np.linspace(0, len(needle) - 1, _MAX_POINTS).round().astype(int))
    line = np.asarray(project(needle[chosen]), np.float64)
    return np.clip(line[np.isfinite(line).all(axis=1)], -_MAX_COORDINATE_PX, _MAX_COORDINATE_PX)


def _small_jpeg(image: Image) -> bytes:
    """Return an image as a JPEG of at most `_LARGEST_PX` and `MAX_BYTES`."""
    height, width = image.shape
    scale = min(1.0, _LARGEST_PX[0] / width, _LARGEST_PX[1] / height)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    data = b""
    for quality in _QUALITIES:
        done, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
        data = bytes(encoded) if done else b""
        if len(data) <= MAX_BYTES:
            break
    return data
