"""Typed access to a recorded run: arrays of the rig's messages from a bag."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_messages import read_contents, read_messages
from needle_bags.reading.bag_rigs import CALIBRATION, namespace_of, namespaces, require_types
from needle_core.errors import UserError
from needle_core.files.plain_yaml import load_plain

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

_NANOSECONDS = 1_000_000_000
# Row length of each series.
_WIDTHS = {
    **{"tips": 3, "tip_covariances": 9, "truth": 7, "estimate": 7, "estimate_covariances": 36},
    **{"reduced_state": 3, "joints": 2, "control_input": 3, "commands": 2, "holds": 2},
}
RECORDING = ("recording_ended", "recovered", "messages_lost", "parameter_changes")


class _HasStamp(Protocol):
    sec: int
    nanosec: int


@dataclasses.dataclass(frozen=True)
class Series:
    """Stamped rows of numbers.

    Attributes
    ----------
    stamps : (N,) int64
        Time of exposure or sampling, ROS clock [ns].
    values : (N, K) float64
        One row for each stamp, SI.
    received : (N,) int64
        When each was received, system clock [ns].
    """

    stamps: Stamps
    values: Floats
    received: Stamps

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.stamps)

    def at(self, stamps: Stamps) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return (indices here, indices in `stamps`) of the stamps that both have."""
        _, here, there = np.intersect1d(self.stamps, stamps, return_indices=True)
        return here.astype(np.int64), there.astype(np.int64)


@dataclasses.dataclass(frozen=True)
class Status:
    """One DiagnosticStatus: when it was received (system clock, ns), its keys and values."""

    log_time: int
    values: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Result:
    """Result of a step: the stamp of its command, and `succeeded` or `aborted: reason`."""

    log_time: int
    stamp: int
    outcome: str


@dataclasses.dataclass(frozen=True)
class HealthEvent:
    """A change in /diagnostics: a part with a problem, or recovered (level 0)."""

    log_time: int
    part: str
    level: int
    message: str


@dataclasses.dataclass(frozen=True)
class Run:
    """Contents of the bag of a run, without images (`bag_images`).

    Attributes
    ----------
    path : Path
        The bag.
    tips : Series
        Measured tips in `rig`, (N, 3) [m].
    tip_covariances : Series
        Position covariance of every exposure, (N, 9) [m^2]; infinite: no tip found.
    truth : Series
        Ground truth in `rig`: position and quaternion x y z w, (N, 7).
    estimate : Series
        Estimate in `target_plane`: position and quaternion, (N, 7).
    estimate_covariances : Series
        Its covariance as the message has it, (N, 36): position, rotation about fixed axes.
    reduced_state : Series
        r = (x, beta, gamma) in `target_plane`, (N, 3) [m, rad, rad].
    joints : Series
        Insertion [m] and rotation [rad], (N, 2).
    control_input : Series
        v, u [rad/m] and accumulated rotation [rad], (N, 3).
    commands : Series
        Commanded insertion [m] and rotation [rad], (N, 2), with the stamp of the causing tip.
    holds : Series
        Hold pressed (0 or 1) and speed scale, (N, 2), with their time of arrival.
    controller_status, device_status : list of Status
        In order of arrival.
    results : list of Result
        In order of arrival.
    health : list of HealthEvent
        Problems and recoveries, in order of arrival.
    topics : dict of str to int
        Messages for each topic.
    parameters : dict
        Node name to its parameters at the start.
    run_info, versions : dict
        Description of the run, and versions of its software.
    calibration, commit : str
        Text of the calibration (from the tracker, or given to the recorder) and commit of the
        sources; empty if unknown.
    recording : dict of str to str
        Notes of the recorder or of `recover`: keys of `RECORDING`.
    namespace : str
        Namespace of the rig's topics, ends with `/`.
    """

    path: Path
    tips: Series
    tip_covariances: Series
    truth: Series
    estimate: Series
    estimate_covariances: Series
    reduced_state: Series
    joints: Series
    control_input: Series
    commands: Series
    holds: Series
    controller_status: list[Status]
    device_status: list[Status]
    results: list[Result]
    health: list[HealthEvent]
    topics: dict[str, int]
    parameters: dict[str, dict[str, Any]]
    run_info: dict[str, Any]
    versions: dict[str, str]
    calibration: str
    commit: str
    recording: dict[str, str]
    namespace: str

    @property
    def first_command(self) -> int | None:
        """Time of the first command of a step, system clock [ns]."""
        return int(self.commands.received.min()) if len(self.commands) else None

    def joints_at(self, stamps: Stamps) -> Floats:
        """Return interpolated joints, (N, 2) [m, rad], at ROS times [ns]; NaN without any."""
        if not len(self.joints):
            return np.full((len(stamps), 2), np.nan)
        start = self.joints.stamps[0]
        at, known = ((x - start).astype(np.float64) for x in (stamps, self.joints.stamps))
        return np.column_stack([np.interp(at, known, row) for row in self.joints.values.T])

    def insertion_at(self, stamps: Stamps) -> Floats:
        """Return the insertion depth [m], (N,), at ROS times [ns]; NaN without any joints."""
        return self.joints_at(stamps)[:, 0]

    def last_status(self, key: str) -> str:
        """Return the last value of a key of the controller status; empty without any."""
        for status in reversed(self.controller_status):
            if key in status.values:
                return status.values[key]
        return ""

    def parameter(self, node: str, name: str) -> Any:
        """Return a node's parameter, None if it is not recorded.

        The node of this rig, or otherwise the only node of that name.
        """
        own = self.parameters.get(f"{self.namespace}{node}")
        if own is not None:
            return own.get(name)
        others = [
            values
            for full_name, values in self.parameters.items()
            if full_name.rsplit("/", maxsplit=1)[-1] == node
        ]
        return others[0].get(name) if len(others) == 1 else None


def read_run(path: Path, namespace: str | None = None) -> Run:
    """Read a run from its bag.

    Parameters
    ----------
    path : Path
        A rosbag2 directory.
    namespace : str, optional
        Namespace of the rig; required if the bag holds several.

    Raises
    ------
    UserError
        If there is no bag, it is broken or incomplete, or it holds no needle run, or several and
        no namespace is given.
    """
    contents = read_contents(path)
    custom = contents.custom_data
    namespace = namespace_of(contents, namespace)
    collected = _Collector(namespace, namespaces(contents))
    handlers = {namespace + name: handler for name, handler in collected.handlers().items()}
    handlers["/diagnostics"] = collected.add_diagnostics
    require_types(contents, namespace)
    for topic, log_time, message in read_messages(path, lambda name: name in handlers):
        try:
            handlers[topic](log_time, message)
        except (AttributeError, TypeError, ValueError) as error:
            where = contents.distribution or "another distribution"
            raise UserError(
                f"{path}: {topic} is not {contents.topics[topic].type_name} as Jazzy has it "
                f"(bag of {where}: {error}): record it with ROS 2 Jazzy"
            ) from error
    return Run(
        path=path,
        **{name: collected.series(name, width) for name, width in _WIDTHS.items()},
        controller_status=collected.controller_status,
        device_status=collected.device_status,
        results=collected.results,
        health=collected.health,
        topics=contents.counts,
        parameters=_parameters(custom.get("parameters", "")),
        run_info=_mapping(custom.get("run_info", "")),
        versions={str(k): str(v) for k, v in _mapping(custom.get("versions", "")).items()},
        calibration=collected.calibration or custom.get("calibration", ""),
        commit=custom.get("commit", ""),
        recording={key: custom[key] for key in RECORDING if custom.get(key)},
        namespace=namespace,
    )


class _Collector:
    """Collects the messages of one rig as rows, topic by topic."""

    def __init__(self, namespace: str, rigs: Sequence[str]) -> None:
        self._own = namespace.lstrip("/")
        self._others = tuple(rig.lstrip("/") for rig in rigs if rig not in ("/", namespace))
        self._rows: dict[str, list[tuple[int, int, tuple[float, ...]]]] = {}
        self.controller_status: list[Status] = []
        self.device_status: list[Status] = []
        self.results: list[Result] = []
        self.health: list[HealthEvent] = []
        self.calibration = ""
        self._last_health: dict[str, tuple[int, str]] = {}

    def handlers(self) -> dict[str, Callable[[int, Any], None]]:
        """Return the handlers by relative topic name."""
        return {
            "needle/tip": lambda t, m: self._add("tips", t, m, _xyz(m.point)),
            "needle/tip_pose": lambda t, m: self._add(
                "tip_covariances",
                t,
                m,
                tuple(np.reshape(m.pose.covariance, (6, 6))[:3, :3].ravel()),
            ),
            "sim/tip_pose": lambda t, m: self._add("truth", t, m, _pose(m.pose)),
            "needle/estimate": self._add_estimate,
            "needle/reduced_state": lambda t, m: self._add("reduced_state", t, m, _xyz(m.vector)),
            "needle/control_input": lambda t, m: self._add("control_input", t, m, _xyz(m.vector)),
            "device/hold": self._add_hold,
            "joint_states": self._add_joints,
            "device/joint_trajectory": self._add_command,
            "device/result": self._add_result,
            "needle/controller_status": lambda t, m: self.controller_status.append(
                Status(t, {pair.key: pair.value for pair in m.values})
            ),
            "device/status": lambda t, m: self.device_status.append(
                Status(t, {pair.key: pair.value for pair in m.values})
            ),
            CALIBRATION: self._add_calibration,
        }

    def series(self, name: str, width: int) -> Series:
        """Return the rows of a series sorted by stamp; of equal stamps the first."""
        rows = self._rows.get(name, [])
        stamps = np.array([stamp for stamp, _, _ in rows], dtype=np.int64)
        received = np.array([log_time for _, log_time, _ in rows], dtype=np.int64)
        values = np.array([row for _, _, row in rows], dtype=np.float64).reshape(len(rows), width)
        unique, first = np.unique(stamps, return_index=True)
        return Series(unique, values[first], received[first])

    def _add(self, name: str, log_time: int, message: Any, row: tuple[float, ...]) -> None:
        rows = self._rows.setdefault(name, [])
        rows.append((nanoseconds(message.header.stamp), log_time, row))

    def _add_estimate(self, log_time: int, message: Any) -> None:
        self._add("estimate", log_time, message, _pose(message.pose.pose))
        covariance = tuple(float(value) for value in message.pose.covariance)
        self._add("estimate_covariances", log_time, message, covariance)

    def _add_hold(self, log_time: int, message: Any) -> None:
        pressed = float(message.buttons[0]) if len(message.buttons) else 0.0
        scale = float(message.axes[0]) if len(message.axes) else 0.0
        # The stamp of a hold is a counter of its source.
        self._rows.setdefault("holds", []).append((log_time, log_time, (pressed, scale)))

    def _add_joints(self, log_time: int, message: Any) -> None:
        position = dict(zip(message.name, message.position, strict=False))
        if "insertion_joint" in position and "rotation_joint" in position:
            row = (float(position["insertion_joint"]), float(position["rotation_joint"]))
            self._add("joints", log_time, message, row)

    def _add_command(self, log_time: int, message: Any) -> None:
        insertion = rotation = np.nan
        if len(message.points) == 1:
            positions = dict(zip(message.joint_names, message.points[0].positions, strict=False))
            insertion = float(positions.get("insertion_joint", np.nan))
            rotation = float(positions.get("rotation_joint", np.nan))
        self._add("commands", log_time, message, (insertion, rotation))

    def _add_calibration(self, _: int, message: Any) -> None:
        self.calibration = str(message.data)

    def _add_result(self, log_time: int, message: Any) -> None:
        self.results.append(Result(log_time, nanoseconds(message.stamp), message.frame_id))

    def add_diagnostics(self, log_time: int, message: Any) -> None:
        """Add the changes between problem and recovery of each part."""
        for status in message.status:
            name = str(status.name).removeprefix(self._own)
            if name == status.name and name.startswith(self._others):
                continue
            now = (int(status.level), str(status.message))
            before = self._last_health.get(name, (0, ""))
            if before != now and (now[0] or before[0]):
                self.health.append(HealthEvent(log_time, name, *now))
            self._last_health[name] = now


def _parameters(text: str) -> dict[str, dict[str, Any]]:
    nodes = _mapping(text)
    return {
        str(node): dict(entry.get("ros__parameters") or {})
        for node, entry in nodes.items()
        if isinstance(entry, dict)
    }


def _mapping(text: str) -> dict[str, Any]:
    """Return YAML or JSON text as a mapping; other text under the key `text`."""
    try:
        value = json.loads(text) if text.lstrip().startswith("{") else load_plain(text)
    except ValueError:
        value = text
    if value is None:
        return {}
    return value if isinstance(value, dict) else {"text": str(value)}


def nanoseconds(stamp: _HasStamp) -> int:
    """Return a message's stamp in ns since the clock's epoch."""
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def _xyz(vector: Any) -> tuple[float, ...]:
    return (float(vector.x), float(vector.y), float(vector.z))


def _pose(pose: Any) -> tuple[float, ...]:
    q = pose.orientation
    return (*_xyz(pose.position), float(q.x), float(q.y), float(q.z), float(q.w))
