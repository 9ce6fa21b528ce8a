"""Folder of rendered pairs with calibration, insertions and ground truth, for `track_images`."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from needle_core.errors import UserError
from needle_core.files.file_access import make_folder
from needle_sim.camera.view import GreyImage
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.se3 import FloatArray

_INSERTION_COLUMNS = ("name", "insertion_m")
_TRUTH_COLUMNS = (
    *("name", "x_m", "y_m", "z_m", "pitch_rad", "yaw_rad", "shaft_pitch_rad", "shaft_yaw_rad"),
    *("left_seen", "right_seen"),
)
# A higher compression level saves nothing, because noise does not compress.
_PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 1)


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of the needle's end; pitch = asin(d_x), yaw = atan2(-d_y, d_z).

    Attributes
    ----------
    tip : ndarray, shape (3,)
        Tip in `rig` [m].
    pitch, yaw : float
        Direction of the heading [rad].
    shaft_pitch, shaft_yaw : float
        Direction of the visible distal segment, tilted from the heading by the pre-bend [rad].
    """

    tip: FloatArray
    pitch: float
    yaw: float
    shaft_pitch: float
    shaft_yaw: float


def truth_of(T_rig_tip: FloatArray, needle: NeedleShape | None = None) -> Truth:  # noqa: N803
    """Return the ground truth of a needle from the pose of its tip, shape (4, 4) [m]."""
    needle = NeedleShape() if needle is None else needle
    heading = T_rig_tip[:3, 2]
    shaft = T_rig_tip[:3, :3] @ [0.0, -np.sin(needle.lean), np.cos(needle.lean)]
    angles = [
        angle
        for direction in (heading, shaft)
        for angle in (
            float(np.arcsin(np.clip(direction[0], -1.0, 1.0))),
            float(np.arctan2(-direction[1], direction[2])),
        )
    ]
    return Truth(np.array(T_rig_tip[:3, 3]), *angles)


@dataclasses.dataclass(frozen=True, eq=False)
class RenderedPair:
    """Exposure of an insertion.

    Attributes
    ----------
    number : int
        Number of the exposure, which names its files.
    images : pair of ndarray of uint8
        Left and right image.
    insertion : float
        Insertion of the stage [m].
    truth : Truth or None
        Ground truth; None without a needle in the phantom.
    visible_share : pair of float
        Visible share of the needle's last 10 mm, in the left and the right image.
    more : sequence of float or str
        Values of the folder's additional columns.
    """

    number: int
    images: tuple[GreyImage, GreyImage]
    insertion: float
    truth: Truth | None
    visible_share: tuple[float, float]
    more: Sequence[float | str] = ()


class ImageFolder:
    """Writes left/NNNNNN.png, right/NNNNNN.png, calibration.yaml, insertion.csv and truth.csv.

    Parameters
    ----------
    folder : Path
        New or empty folder.
    calibration_file : Path
        Calibration to copy.
    more_columns : tuple of str
        Additional columns of truth.csv.

    Raises
    ------
    UserError
        If the folder is not empty, or cannot be written.
    """

    def __init__(
        self, folder: Path, calibration_file: Path, more_columns: tuple[str, ...] = ()
    ) -> None:
        self._folder = folder
        with self._reported_errors():
            make_folder(folder)
            calibration = calibration_file.read_bytes()
            (folder / "calibration.yaml").write_bytes(calibration)
            for side in ("left", "right"):
                (folder / side).mkdir()
            self._add("insertion.csv", _INSERTION_COLUMNS)
            self._add("truth.csv", _TRUTH_COLUMNS + more_columns)

    def write(self, pair: RenderedPair) -> None:
        """Add an exposure; its fields are empty without a needle.

        Raises
        ------
        UserError
            If a file cannot be written.
        """
        name = f"{pair.number:06d}.png"
        values: list[float | str] = [""] * 7
        if (truth := pair.truth) is not None:
            angles = (truth.pitch, truth.yaw, truth.shaft_pitch, truth.shaft_yaw)
            values = [*truth.tip.tolist(), *angles]
        visible = [round(share, 3) for share in pair.visible_share]
        with self._reported_errors():
            for side, image in zip(("left", "right"), pair.images, strict=True):
                data = cv2.imencode(".png", image, _PNG_OPTIONS)[1]
                (self._folder / side / name).write_bytes(data.tobytes())
            self._add("insertion.csv", [name, repr(float(pair.insertion))])
            # repr() keeps all digits.
            row = (v if isinstance(v, str) else repr(v) for v in (*values, *visible, *pair.more))
            self._add("truth.csv", [name, *row])

    def _add(self, table: str, row: Sequence[str]) -> None:
        """Add a row to a table, which is closed again: it is complete at any time."""
        with (self._folder / table).open("a", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerow(row)

    @contextlib.contextmanager
    def _reported_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UserError(f"cannot write {self._folder}: {error.strerror}") from error
