"""Tips of one insertion, read from a CSV or a bag, for `identify_curvature`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import point_from_message
from needle_controller.protocol.joint_history import joint_sample
from needle_core.commands.csv_files import read_insertions, read_rows
from needle_core.commands.options import number
from needle_core.convert import from_ros
from needle_core.errors import UserError
from needle_core.messages import JointState, Point

_COORDINATES = ("x_m", "y_m", "z_m")
_LARGEST = {"m": 1.0, "rad": 1e4}
"""Largest plausible value, by its unit."""


@dataclasses.dataclass(frozen=True)
class InsertionRecord:
    """Tips of one insertion in the order of their measurement.

    Attributes
    ----------
    tips : ndarray, shape (K, 3)
        Measured tips in `rig` [m].
    insertion : ndarray, shape (K,), or None
        Inserted length at each tip [m]; None if it was not recorded.
    rotation : ndarray, shape (K,), or None
        Rotation of the base at each tip [rad]; None if it was not recorded.
    """

    tips: Array
    insertion: Array | None
    rotation: Array | None

    def between(self, least: float, most: float) -> InsertionRecord:
        """Return the part between two inserted lengths, without retraction.

        Parameters
        ----------
        least, most : float
            Bounds of the inserted length [m].

        Raises
        ------
        UserError
            A part is requested, but the insertion was not recorded.
        """
        if self.insertion is None:
            if least > 0.0 or math.isfinite(most):
                raise UserError("--from-mm and --until-mm need insertions, which are not recorded")
            return self
        kept = (self.insertion >= least) & (self.insertion <= most)
        # A retracted needle follows its own path back.
        deepest = np.flatnonzero(self.insertion >= np.max(self.insertion, initial=0.0) - 1e-6)
        kept[int(deepest[-1]) + 1 if len(deepest) else 0 :] = False
        rotation = None if self.rotation is None else self.rotation[kept]
        return InsertionRecord(self.tips[kept], self.insertion[kept], rotation)

    def check_pure(self, tolerance: float) -> None:
        """Check that the base did not turn.

        Parameters
        ----------
        tolerance : float
            Largest allowed rotation [rad].

        Raises
        ------
        UserError
            The base turned; the message gives angle and insertion.
        """
        if self.rotation is None or len(self.rotation) == 0:
            return
        turned = np.abs(self.rotation - self.rotation[0])
        if np.max(turned) <= tolerance:
            return
        where = ""
        if self.insertion is not None:
            first = float(self.insertion[int(np.argmax(turned > tolerance))])
            where = f" from {1e3 * first:.1f} mm of insertion on (--until-mm keeps the part before)"
        raise UserError(
            f"this is not a pure insertion: the base turned by {math.degrees(np.max(turned)):.2f} "
            f"deg, limit {math.degrees(tolerance):.2f} deg{where}"
        )


def read_record(path: Path, insertion_file: Path | None = None) -> InsertionRecord:
    """Read a CSV of tips or a bag.

    Parameters
    ----------
    path : Path
        A CSV with the columns x_m, y_m, z_m and, optionally, insertion_m, rotation_rad, valid and
        name; or the directory of a rosbag2 bag with `needle/tip` and `joint_states`.
    insertion_file : Path, optional
        A CSV name,insertion_m for a CSV of tips with names.

    Raises
    ------
    UserError
        A file that cannot be read, or a bad value; the message gives line and value.
    """
    if path.is_dir():
        if insertion_file is not None:
            raise UserError("--insertion goes with a CSV of tips; a bag has joint_states")
        return read_bag(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or bag")
    return read_csv(path, insertion_file)


def read_csv(path: Path, insertion_file: Path | None = None) -> InsertionRecord:
    """Read a CSV of tips; see `read_record`."""
    of_name = None if insertion_file is None else read_insertions(insertion_file)
    rows = read_rows(path, _COORDINATES if of_name is None else ("name", *_COORDINATES))
    if not rows:
        raise UserError(f"{path}: the file has no rows")
    columns = set(rows[0][1])
    tips, insertion, rotation = [], [], []
    for where, row in rows:
        if row.get("valid", "1") in ("0", "false", "False"):
            continue
        if all(not row[name] for name in _COORDINATES):
            continue
        tips.append([_number(where, row, name) for name in _COORDINATES])
        if of_name is not None:
            # By the image's name with or without its suffix, as in `track_images`.
            length = of_name.get(row["name"], of_name.get(Path(row["name"]).stem))
            if length is None:
                raise UserError(f"{insertion_file}: no insertion for {row['name']}")
            insertion.append(length)
        elif "insertion_m" in columns:
            insertion.append(_number(where, row, "insertion_m"))
        if "rotation_rad" in columns:
            rotation.append(_number(where, row, "rotation_rad"))
    return InsertionRecord(
        np.array(tips, dtype=float).reshape(-1, 3),
        np.array(insertion) if insertion else None,
        np.array(rotation) if rotation else None,
    )


def read_bag(path: Path) -> InsertionRecord:
    """Read tips and joints of a bag; see `read_record`.

    Insertion and rotation are interpolated at the tips' stamps; tips outside the recorded joints
    are omitted.
    """
    # Imported here, because reading a CSV does not need it.
    from needle_core.files.bag_directory import BagDirectory  # noqa: PLC0415

    tips: dict[int, Array] = {}
    joints: dict[int, tuple[float, float]] = {}

    def is_selected(topic: str) -> bool:
        return ("/" + topic.lstrip("/")).endswith(("/needle/tip", "/joint_states"))

    with BagDirectory(path) as bag:
        store = bag.typestore()
        for sent in bag.messages(is_selected):
            message = bag.deserialize(store, sent)
            try:
                if sent.topic.endswith("joint_states"):
                    # Others may publish other joints.
                    with contextlib.suppress(UserError):
                        at = joint_sample(from_ros(JointState, message), sent.time)
                        joints.setdefault(at.stamp_ns, (at.insertion, at.rotation))
                    continue
                tip = from_ros(Point, message)
                point = point_from_message(f"{path}: a tip", tip.frame_id, tip.position)
                tips.setdefault(tip.stamp_ns, point)
            except AttributeError as error:
                raise UserError(f"{path}: {sent.topic} has an unexpected type: {error}") from error
    for topic, found in (("needle/tip", tips), ("joint_states", joints)):
        if not found:
            raise UserError(f"{path}: the bag has no messages on {topic}")
    times = np.array(sorted(joints), dtype=np.int64)
    values = np.array([joints[t] for t in times.tolist()])
    stamps = np.array([t for t in sorted(tips) if times[0] <= t <= times[-1]], dtype=np.int64)
    then, known = (stamps - times[0]).astype(float), (times - times[0]).astype(float)
    return InsertionRecord(
        np.array([tips[t] for t in stamps.tolist()]).reshape(-1, 3),
        np.interp(then, known, values[:, 0]),
        np.interp(then, known, values[:, 1]),
    )


def _number(where: str, row: dict[str, str], name: str) -> float:
    unit = name.rpartition("_")[2]
    largest = _LARGEST[unit]
    return number(f"{where}: {name}", row[name], -largest, largest, unit)
