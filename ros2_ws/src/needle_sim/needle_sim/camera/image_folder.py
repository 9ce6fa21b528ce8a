"""A folder of rendered pairs with calibration, insertions and truth, as `track_images` reads it."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from needle_core.errors import UserError
from needle_sim.camera.view import GreyImage
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.se3 import FloatArray

CALIBRATION = "calibration.yaml"
INSERTION = "insertion.csv"
TRUTH = "truth.csv"
_INSERTION_COLUMNS = ("name", "insertion_m")
_TRUTH_COLUMNS = (
    *("name", "x_m", "y_m", "z_m", "pitch_rad", "yaw_rad", "shaft_pitch_rad", "shaft_yaw_rad"),
    *("left_seen", "right_seen"),
)
# Noise does not compress: more effort takes time and saves nothing.
_PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 1)


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """True place of the needle's end; angles as everywhere: asin(d_x), atan2(-d_y, d_z).

    Attributes
    ----------
    tip : ndarray, shape (3,)
        In `rig` [m].
    pitch, yaw : float
        Of the heading [rad].
    shaft_pitch, shaft_yaw : float
        Of the visible shaft's end, which the pre-bend leans away from the heading [rad].
    """

    tip: FloatArray
    pitch: float
    yaw: float
    shaft_pitch: float
    shaft_yaw: float


def truth_of(T_rig_tip: FloatArray, needle: NeedleShape | None = None) -> Truth:  # noqa: N803
    """Return the truth about a needle whose tip has a pose, shape (4, 4) [m]."""
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


class ImageFolder:
    """Writes left/NNNNNN.png, right/NNNNNN.png, calibration.yaml, insertion.csv and truth.csv.

    Parameters
    ----------
    folder : Path
        New or empty.
    calibration_file : Path
        Copied.
    more_columns : tuple of str
        Of truth.csv, behind those that are always there.

    Raises
    ------
    UserError
        If the folder has something in it, or cannot be written.
    """

    def __init__(
        self, folder: Path, calibration_file: Path, more_columns: tuple[str, ...] = ()
    ) -> None:
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise UserError(f"{folder} is not empty")
            calibration = calibration_file.read_bytes()
            (folder / CALIBRATION).write_bytes(calibration)
            for side in ("left", "right"):
                (folder / side).mkdir()
            self._insertions = self._table(INSERTION, _INSERTION_COLUMNS)
            self._truths = self._table(TRUTH, _TRUTH_COLUMNS + more_columns)
        except OSError as error:
            raise UserError(f"cannot write {folder}: {error.strerror}") from error

    def write(
        self,
        number: int,
        images: tuple[GreyImage, GreyImage],
        insertion: float,
        truth: Truth | None,
        visible_share: tuple[float, float],
        *,
        more: Sequence[float | str] = (),
    ) -> str:
        """Add one exposure; return its name.

        Parameters
        ----------
        number : int
            Of the exposure; names the files.
        images : pair of ndarray of uint8
            Left and right.
        insertion : float
            What the stage says [m].
        truth : Truth or None
            None where there is no needle: empty fields.
        visible_share : pair of float
            Of the needle's last 10 mm, by the left and the right camera.
        more : sequence of float or str
            For the further columns of truth.csv.

        Raises
        ------
        UserError
            If something cannot be written.
        """
        name = f"{number:06d}.png"
        for side, image in zip(("left", "right"), images, strict=True):
            path = self._folder / side / name
            written, data = cv2.imencode(".png", image, _PNG_OPTIONS)
            if not written:
                raise UserError(f"cannot encode {path}")
            try:
                path.write_bytes(data.tobytes())
            except OSError as error:
                raise UserError(f"cannot write {path}: {error.strerror}") from error
        values: list[float | str] = [""] * 7
        if truth is not None:
            angles = (truth.pitch, truth.yaw, truth.shaft_pitch, truth.shaft_yaw)
            values = [*truth.tip.tolist(), *angles]
        self._add(self._insertions, name, [float(insertion)])
        seen = [round(share, 3) for share in visible_share]
        self._add(self._truths, name, [*values, *seen, *more])
        return name

    def close(self) -> None:
        """Close the tables; they are complete up to the last exposure at any time."""
        self._insertions.close()
        self._truths.close()

    def _table(self, name: str, columns: tuple[str, ...]) -> TextIO:
        stream = (self._folder / name).open("w", encoding="utf-8", newline="")
        csv.writer(stream, lineterminator="\n").writerow(columns)
        stream.flush()
        return stream

    def _add(self, stream: TextIO, name: str, values: Sequence[float | str]) -> None:
        try:
            # repr: what is read back is what was written, to the last bit.
            csv.writer(stream, lineterminator="\n").writerow(
                [name, *(value if isinstance(value, str) else repr(value) for value in values)]
            )
            stream.flush()
        except OSError as error:
            raise UserError(f"cannot write {self._folder}: {error.strerror}") from error
