"""Messages on the graph as small dataclasses, in SI units; `convert` maps them to ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from needle_core.diagnostics import Diagnostic, Level

INSERTION_JOINT, ROTATION_JOINT = "insertion_joint", "rotation_joint"
HOLD_LIFETIME = 0.1
"""Lifetime of a hold message: a source that freezes loses its hold after this time [s]."""

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
    frame_id: str = ""


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
        All other numbers of the point: velocities, accelerations, effort.
    """

    positions: tuple[float, ...]
    time_from_start: float
    others: tuple[float, ...] = ()


@dataclass(frozen=True)
class Trajectory:
    """Motion command with the stamp of the tip that caused it."""

    stamp_ns: int
    joint_names: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]


@dataclass(frozen=True)
class CommandResult:
    """Result of a command: its stamp, and `succeeded`, `replaced` or `aborted: reason`."""

    stamp_ns: int
    outcome: str


@dataclass(frozen=True)
class HoldState:
    """State of an operator's hold.

    Attributes
    ----------
    source : str
        Name of the source.
    session : str
        Identifier of the source's process, fixed at its start; empty if not given.
    count : int
        Increasing number of the message within its session.
    pressed : bool
        Whether hold to run is pressed.
    speed_scale : float
        Share of the nominal speed, 0 to 1.
    lifetime : float
        Time for which the message is valid [s]; infinite if not given.
    """

    source: str
    session: str
    count: int
    pressed: bool
    speed_scale: float
    lifetime: float = math.inf

    @property
    def sender(self) -> str:
        """Source and session joined by a slash; the source alone if it has no session."""
        has_slash = self.session or "/" in self.source
        return f"{self.source}/{self.session}" if has_slash else self.source

    @staticmethod
    def split_sender(sender: str) -> tuple[str, str]:
        """Return source and session; the source may contain slashes of its namespace."""
        before, _, after = sender.rpartition("/")
        # A source is never empty: "/me" is a source with a leading slash and no session.
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
class BarePoint:
    """A point without stamp and frame."""

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
class Poses:
    """Positions [m] and orientations, such as those along a needle."""

    stamp_ns: int
    frame_id: str
    poses: tuple[tuple[Vector3, Quaternion], ...]


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
    """Sequence of positions [m]."""

    stamp_ns: int
    frame_id: str
    positions: tuple[Vector3, ...]


@dataclass(frozen=True)
class Transform:
    """Pose of a frame in another one: origin [m] and axes of the child in `frame_id`."""

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
    """Image; `data` has `height` rows of `step` bytes."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    step: int
    data: bytes | memoryview = field(repr=False)


@dataclass(frozen=True)
class CompressedImage:
    """Image as an encoded file; `format` is jpeg or png."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class RegionOfInterest:
    """Part of the sensor that the image covers [px]; 0x0 is the whole sensor."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


@dataclass(frozen=True)
class CameraInfo:
    """Calibration of a camera, with the names of sensor_msgs/CameraInfo."""

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
    """Message of type std_msgs/String."""

    text: str


@dataclass(frozen=True)
class Marker:
    """Marker of visualization_msgs; `colour` is red, green, blue and opacity, 0 to 1.

    Without a stamp it moves with its frame; the default colour is that of obstacles.
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
    """DiagnosticStatus: health of `part` of the node `source`, with key-value pairs."""

    source: str
    part: str
    level: Level
    text: str
    values: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the status in ROS: source and part."""
        return f"{self.source}: {self.part}"

    @staticmethod
    def of(source: str, part: str, diagnostic: Diagnostic) -> Status:
        """Return a diagnostic of a component as a message."""
        return Status(source, part, diagnostic.level, diagnostic.message, diagnostic.values)


@dataclass(frozen=True)
class Diagnostics:
    """Health of the parts of a node, as on /diagnostics."""

    stamp_ns: int
    statuses: tuple[Status, ...]


@dataclass(frozen=True)
class LogLine:
    """Log line of /rosout."""

    stamp_ns: int
    severity: str
    source: str
    text: str


class HoldSession:
    """Creates the hold messages of one source.

    The message number reveals late messages; the session distinguishes them from those of an
    earlier process with the same name.

    Parameters
    ----------
    source : str
        Name of the source, unique on the graph.
    lifetime : float
        Time for which a message is valid [s]; if infinite, the device's own time-out applies.
    """

    def __init__(self, source: str, lifetime: float = HOLD_LIFETIME) -> None:
        self._source, self._lifetime = source, lifetime
        self._session = ""
        self._count = 0

    def next_message(self, stamp_ns: int, *, pressed: bool, speed: float = 1.0) -> HoldState:
        """Return the next message.

        Parameters
        ----------
        stamp_ns : int
            Current time [ns]. The time of the first message becomes the session, because no other
            process of this source starts in the same nanosecond.
        pressed : bool
            Whether hold to run is pressed.
        speed : float
            Share of the nominal speed, 0..1.
        """
        self._session = self._session or f"{stamp_ns:x}"
        self._count += 1
        speed = speed if pressed else 0.0
        return HoldState(self._source, self._session, self._count, pressed, speed, self._lifetime)
