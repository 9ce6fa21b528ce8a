"""Images of the phantom without needle, from a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from needle_core.errors import UserError
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.sources.image_files import Image, open_pairs


def read_reference(folder: Path, calibration: StereoCalibration) -> tuple[Image, Image]:
    """Return the mean of a folder's pairs: several have less noise.

    Parameters
    ----------
    folder : Path
        With the folders `left` and `right`, or two videos of these names.
    calibration : StereoCalibration
        The stereo rig.

    Returns
    -------
    pair of ndarray of uint8, shape (height, width)
        Left and right.

    Raises
    ------
    UserError
        If it is missing, has no pair, or an image cannot be read or is not of the calibration's
        size.
    """
    left, right = (folder / side for side in SIDES)
    sums = [
        np.zeros((camera.height, camera.width)) for camera in (calibration.left, calibration.right)
    ]
    count = 0
    for pair in open_pairs(left, right):
        for side, image, total in zip(SIDES, (pair.left, pair.right), sums, strict=True):
            if image is None or image.shape != total.shape:
                size = f"{total.shape[1]}x{total.shape[0]}"
                path = pair.files[SIDES.index(side)]
                raise UserError(f"{path}: not an image of {size}, 8 bits")
            np.add(total, image, out=total)
        count += 1
    first, second = (np.asarray(np.rint(total / count), np.uint8) for total in sums)
    return first, second
