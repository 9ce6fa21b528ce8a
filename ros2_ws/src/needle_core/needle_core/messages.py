"""Messages on the graph as small dataclasses, in SI units; `convert` maps them to ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from needle_core.diagnostics import Diagnostic, Level

INSERTION_JOINT, ROTATION_JOINT = "insertion_joint", "rotation_joint"
HOLD_LIFETIME = 0.1
"""So long does a message promise a person's hold: who stands still holds no longer [s]."""

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""


@dataclass(frozen=True)
class JointState:
    """Positions [m or rad] and velocities [m/s or rad/s] of named joints at one instant."""

    stamp_ns: int
    names: tuple[str, ...]
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()


@dataclass(frozen=True)
class TrajectoryPoint:
    """One point of a trajectory.

    Attributes
    ----------
    positions : tuple of float
        Target of each joint [m or rad].
    time_from_start : float
        Nominal time at which it is reached [s].
    others : tuple of float
        Every other number that the point carries: velocities, accelerations, effort.
    """

    positions: tuple[float, ...]
    time_from_start: float
    others: tuple[float, ...] = ()


@dataclass(frozen=True)
class Trajectory:
    """A command; its stamp is that of the tip that caused it."""

    stamp_ns: int
    joint_names: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]


@dataclass(frozen=True)
class CommandResult:
    """The end of a command: its stamp, and `succeeded`, `replaced` or `aborted: reason`."""

    stamp_ns: int
    outcome: str


@dataclass(frozen=True)
class HoldState:
    """State of a person's hold.

    Attributes
    ----------
    source : str
        Whose hand.
    session : str
        Of the source's process, made once at its start; empty where it does not say.
    count : int
        Of the session's messages; increases.
    pressed : bool
        Whether hold to run is pressed.
    speed_scale : float
        Share of the nominal speed, 0 to 1.
    lifetime : float
        How long the message counts [s]; infinite where it does not say.
    """

    source: str
    session: str
    count: int
    pressed: bool
    speed_scale: float
    lifetime: float = math.inf

    @property
    def sender(self) -> str:
        """Source and session in one word; a source without a session stands alone."""
        has_slash = self.session or "/" in self.source
        return f"{self.source}/{self.session}" if has_slash else self.source

    @staticmethod
    def split_sender(sender: str) -> tuple[str, str]:
        """Return source and session; a source in a namespace has slashes of its own."""
        before, _, after = sender.rpartition("/")
        # No source is empty: "/me" is a source that somebody typed as nodes are named.
        return (before, after) if before else (sender, "")


@dataclass(frozen=True)
class Joystick:
    """State of a joystick: its axes, -1 to 1, and its buttons."""

    stamp_ns: int
    axes: tuple[float, ...]
    buttons: tuple[int, ...]


@dataclass(frozen=True)
class EmergencyStop:
    """State of the emergency stop."""

    pressed: bool


@dataclass(frozen=True)
class Point:
    """A point [m]: a measured tip, or a target."""

    stamp_ns: int
    frame_id: str
    position: Vector3


@dataclass(frozen=True)
class Vector:
    """Three numbers."""

    stamp_ns: int
    frame_id: str
    values: Vector3


@dataclass(frozen=True)
class Pose:
    """A position [m] and orientation."""

    stamp_ns: int
    frame_id: str
    position: Vector3
    orientation: Quaternion


@dataclass(frozen=True)
class PoseWithCovariance:
    """A pose with its covariance: 36 numbers, row by row, as in geometry_msgs."""

    stamp_ns: int
    frame_id: str
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...]


@dataclass(frozen=True)
class Path:
    """Positions [m], one after the other."""

    stamp_ns: int
    frame_id: str
    positions: tuple[Vector3, ...]


@dataclass(frozen=True)
class Transform:
    """Place of a frame in another one: the child's origin [m] and axes in `frame_id`."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True)
class Transforms:
    """A set of transforms."""

    transforms: tuple[Transform, ...]


@dataclass(frozen=True)
class Image:
    """An image; `data` has `height` rows of `step` bytes."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    step: int
    data: bytes | memoryview = field(repr=False)


@dataclass(frozen=True)
class CompressedImage:
    """An image as the bytes of a file; `format` is jpeg or png."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class RegionOfInterest:
    """Part of the sensor that an image shows [px]; 0x0: all of it."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


@dataclass(frozen=True)
class CameraInfo:
    """A camera's calibration, with the names of sensor_msgs/CameraInfo."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    binning_x: int = 0
    binning_y: int = 0
    roi: RegionOfInterest = RegionOfInterest()


@dataclass(frozen=True)
class Text:
    """A text."""

    text: str


@dataclass(frozen=True)
class Marker:
    """A shape of visualization_msgs; `colour` is red, green, blue and opacity, 0 to 1.

    Without a stamp it is shown where its frame is now; its default colour is that of an obstacle.
    """

    frame_id: str
    namespace: str
    number: int
    kind: int
    action: int
    position: Vector3
    orientation: Quaternion
    scale: Vector3
    stamp_ns: int = 0
    colour: tuple[float, float, float, float] = (0.8, 0.2, 0.2, 0.5)
    points: tuple[Vector3, ...] = ()


@dataclass(frozen=True)
class Markers:
    """A set of markers."""

    markers: tuple[Marker, ...]


@dataclass(frozen=True)
class Status:
    """A DiagnosticStatus: the health of `part` of the node `source`, with key-value pairs."""

    source: str
    part: str
    level: Level
    text: str
    values: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def of(source: str, part: str, diagnostic: Diagnostic) -> Status:
        """Return a component's diagnostic as a message."""
        return Status(source, part, diagnostic.level, diagnostic.message, diagnostic.values)


@dataclass(frozen=True)
class Diagnostics:
    """Health of a node's parts, as on /diagnostics."""

    stamp_ns: int
    statuses: tuple[Status, ...]


@dataclass(frozen=True)
class LogLine:
    """A line of /rosout."""

    stamp_ns: int
    severity: str
    source: str
    text: str


class HoldSession:
    """Makes a source's hold messages.

    They are numbered, so that a late one shows, and told from those of an earlier process of the
    same name by the session.

    Parameters
    ----------
    source : str
        Name by which the device knows whose hold it is.
    lifetime : float
        How long a message promises the hold [s]; infinite: the device's own time-out.
    """

    def __init__(self, source: str, lifetime: float = HOLD_LIFETIME) -> None:
        self._source, self._lifetime = source, lifetime
        self._session = ""
        self._count = 0

    def say(self, stamp_ns: int, *, pressed: bool, speed: float = 1.0) -> HoldState:
        """Return the next message.

        Parameters
        ----------
        stamp_ns : int
            Present time [ns]. That of the first message names the session: no other process of
            this source begins in the same nanosecond, whatever its clock shows.
        pressed : bool
            Whether hold to run is pressed.
        speed : float
            Share of the nominal speed, 0..1.
        """
        self._session = self._session or f"{stamp_ns:x}"
        self._count += 1
        speed = speed if pressed else 0.0
        return HoldState(self._source, self._session, self._count, pressed, speed, self._lifetime)


def quaternion_from_rotation(rotation: Sequence[Sequence[float]]) -> Quaternion:
    """Return the unit quaternion (x, y, z, w) of a rotation matrix, given as three rows.

    Of the four formulas the one with the largest divisor. scipy does the same, but takes a process
    that needs no more of it a quarter of a second to import.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    trace = xx + yy + zz
    _, (x, y, z, w) = max(
        (xx, (1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz)),
        (yy, (xy + yx, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx)),
        (zz, (xz + zx, yz + zy, 1.0 - trace + 2.0 * zz, yx - xy)),
        (trace, (zy - yz, xz - zx, yx - xy, 1.0 + trace)),
        key=lambda way: way[0],
    )
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / norm, y / norm, z / norm, w / norm)
