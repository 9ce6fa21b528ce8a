"""Typed access to a recorded run: arrays of the rig's messages from a bag."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_messages import read_contents, read_messages
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory
from needle_core.files.yaml_files import load_yaml
from needle_core.message_types import to_nanoseconds
from needle_core.messages import INSERTION_JOINT, ROTATION_JOINT

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

CALIBRATION = "stereo_tracker/calibration"
_CONTROLLER, _DEVICE, _RESULT = "needle/controller_status", "device/status", "device/result"
_HEALTH = "/diagnostics"
RECORDING = ("recording_ended", "recovered", "messages_lost", "parameter_changes")


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
        Time of reception of each row, system clock [ns].
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
    """Receive time (system clock [ns]) and key-value pairs of a DiagnosticStatus."""

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
    """Change in /diagnostics: a new problem of a part, or its recovery (level 0)."""

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
        Position covariance of every exposure, (N, 9) [m^2]; infinite if no tip was found.
    truth : Series
        Ground truth in `rig`: position and quaternion x y z w, (N, 7).
    estimate : Series
        Estimate in `target_plane`: position and quaternion, (N, 7).
    estimate_covariances : Series
        Covariance of the estimate as in the message, (N, 36): position, rotation about fixed axes.
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
        Status messages, in order of arrival.
    results : list of Result
        Results of the steps, in order of arrival.
    health : list of HealthEvent
        Problems and recoveries, in order of arrival.
    topics : dict of str to int
        Number of messages by topic.
    parameters : dict
        Node name to its parameters at the start.
    run_info, versions : dict
        Description of the run, and versions of its software.
    calibration, commit : str
        Text of the calibration (from the tracker, or in a copy of a bag) and commit of the
        sources; empty if unknown.
    recording : dict of str to str
        Notes of the recorder or of `recover`: keys of `RECORDING`.
    namespace : str
        Namespace of the rig's topics; it ends with `/`.
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
        """Return interpolated joints, (N, 2) [m, rad], at ROS times [ns]; NaN if there are none."""
        if not len(self.joints):
            return np.full((len(stamps), 2), np.nan)
        start = self.joints.stamps[0]
        at, known = ((x - start).astype(np.float64) for x in (stamps, self.joints.stamps))
        return np.column_stack([np.interp(at, known, row) for row in self.joints.values.T])

    def insertion_at(self, stamps: Stamps) -> Floats:
        """Return the insertion depth [m], (N,), at ROS times [ns]; NaN as in `joints_at`."""
        return self.joints_at(stamps)[:, 0]

    def last_status(self, key: str) -> str:
        """Return the last value of a key of the controller status; empty if there is none."""
        for status in reversed(self.controller_status):
            if key in status.values:
                return status.values[key]
        return ""

    def parameter(self, node: str, name: str) -> Any:
        """Return a node's parameter; None if it was not recorded.

        The node is that of this rig or, failing that, the only one of that name.
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
        Namespace of the rig; required if the bag contains several.

    Raises
    ------
    UserError
        If there is no bag, it is broken or incomplete, or it contains no needle run, or several
        and no namespace is given.
    """
    contents = read_contents(path)
    custom = contents.custom_data
    namespace = namespace_of(contents, namespace)
    topics = {topic for topic, _, _ in _SERIES.values()}
    topics |= {_CONTROLLER, _DEVICE, _RESULT, CALIBRATION}
    names = {namespace + topic: topic for topic in topics} | {_HEALTH: _HEALTH}
    found: dict[str, _Messages] = {topic: [] for topic in names.values()}
    for topic, log_time, message in read_messages(path, names.__contains__):
        found[names[topic]].append((log_time, message))
    calibrations = [str(message.data) for _, message in found[CALIBRATION]]
    try:
        return Run(
            path=path,
            **{name: _series(name, found[topic]) for name, (topic, _, _) in _SERIES.items()},
            controller_status=_statuses(found[_CONTROLLER]),
            device_status=_statuses(found[_DEVICE]),
            results=[Result(t, to_nanoseconds(m.stamp), m.frame_id) for t, m in found[_RESULT]],
            health=_health_events(found[_HEALTH], namespace, namespaces(contents)),
            topics=contents.counts,
            parameters=_parameters(custom.get("parameters", "")),
            run_info=_mapping(custom.get("run_info", "")),
            versions={str(k): str(v) for k, v in _mapping(custom.get("versions", "")).items()},
            calibration=calibrations[-1] if calibrations else custom.get("calibration", ""),
            commit=custom.get("commit", ""),
            recording={key: custom[key] for key in RECORDING if custom.get(key)},
            namespace=namespace,
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is not of the rig's graph as ROS 2 Jazzy has it (bag of "
            f"{contents.distribution or 'another distribution'}: {error})"
        ) from error


def namespaces(contents: BagDirectory) -> list[str]:
    """Return the namespaces of the rigs in a bag; each ends with `/`."""
    return sorted(
        name.removesuffix(_CONTROLLER)
        for name in contents.topics
        if name.endswith(f"/{_CONTROLLER}")
    )


def namespace_of(contents: BagDirectory, requested: str | None = None) -> str:
    """Return the namespace of the rig to read; it ends with `/`.

    Parameters
    ----------
    contents : BagDirectory
        The bag.
    requested : str, optional
        Namespace given by the user; required if the bag contains several rigs.

    Raises
    ------
    UserError
        If the bag contains no rig, not the requested one, or several and no namespace is given.
    """
    found = namespaces(contents)
    if not found:
        raise UserError(
            f"{contents.path} contains no needle run: no topic {_CONTROLLER} among its "
            f"{len(contents.topics)}; give a bag that the rig's recorder made"
        )
    listed = ", ".join(name.rstrip("/") or "/" for name in found)
    if requested is not None:
        namespace = f"/{requested.strip('/')}/".replace("//", "/")
        if namespace not in found:
            raise UserError(f"{contents.path} has no rig in {requested}; it has rigs in {listed}")
        return namespace
    if len(found) > 1:
        raise UserError(
            f"{contents.path} holds {len(found)} rigs, in {listed}: choose one with --namespace"
        )
    return found[0]


_Messages = list[tuple[int, Any]]
"""Log times [ns] and messages of a topic."""


def _statuses(messages: _Messages) -> list[Status]:
    return [Status(t, {pair.key: pair.value for pair in m.values}) for t, m in messages]


def _health_events(messages: _Messages, namespace: str, rigs: Sequence[str]) -> list[HealthEvent]:
    """Return the problems and recoveries of each part, without the parts of other rigs."""
    own = namespace.lstrip("/")
    others = tuple(rig.lstrip("/") for rig in rigs if rig not in ("/", namespace))
    last: dict[str, tuple[int, str]] = {}
    events = []
    for log_time, status in ((t, status) for t, m in messages for status in m.status):
        name = str(status.name).removeprefix(own)
        if name == status.name and name.startswith(others):
            continue
        now = (int(status.level), str(status.message))
        before = last.get(name, (0, ""))
        if before != now and (now[0] or before[0]):
            events.append(HealthEvent(log_time, name, *now))
        last[name] = now
    return events


def _series(name: str, messages: _Messages) -> Series:
    """Return the rows of a series sorted by stamp, only the first of equal stamps."""
    _, width, row_of = _SERIES[name]
    # The header stamp of a hold is a message counter, so use the time of reception.
    rows = [
        (log_time if name == "holds" else to_nanoseconds(message.header.stamp), log_time, row)
        for log_time, message in messages
        if (row := row_of(message)) is not None
    ]
    values = np.array([row for *_, row in rows], np.float64).reshape(len(rows), width)
    received = np.array([log_time for _, log_time, _ in rows], np.int64)
    unique, first = np.unique(np.array([row[0] for row in rows], np.int64), return_index=True)
    return Series(unique, values[first], received[first])


def _parameters(text: str) -> dict[str, dict[str, Any]]:
    nodes = _mapping(text)
    return {
        str(node): dict(entry.get("ros__parameters") or {})
        for node, entry in nodes.items()
        if isinstance(entry, dict)
    }


def _mapping(text: str) -> dict[str, Any]:
    """Parse YAML or JSON text as a mapping; other text is stored under the key `text`."""
    try:
        value = json.loads(text) if text.lstrip().startswith("{") else load_yaml(text)
    except ValueError:
        value = text
    if value is None:
        return {}
    return value if isinstance(value, dict) else {"text": str(value)}


def _xyz(vector: Any) -> tuple[float, ...]:
    return (vector.x, vector.y, vector.z)


def _pose(pose: Any) -> tuple[float, ...]:
    return (*_xyz(pose.position), *_xyz(pose.orientation), pose.orientation.w)


def _tip_covariance(message: Any) -> Floats:
    return np.reshape(message.pose.covariance, (6, 6))[:3, :3].ravel()


def _hold(message: Any) -> tuple[float, ...]:
    pressed = message.buttons[0] if len(message.buttons) else 0
    return (pressed, message.axes[0] if len(message.axes) else 0.0)


def _joints(names: Sequence[str], positions: Sequence[float]) -> tuple[float, ...] | None:
    at: Mapping[str, float] = dict(zip(names, positions, strict=False))
    if INSERTION_JOINT not in at or ROTATION_JOINT not in at:
        return None
    return (at[INSERTION_JOINT], at[ROTATION_JOINT])


def _command(message: Any) -> tuple[float, ...]:
    joints = None
    if len(message.points) == 1:
        joints = _joints(message.joint_names, message.points[0].positions)
    return joints or (math.nan, math.nan)


_SERIES: Mapping[str, tuple[str, int, Callable[[Any], Any]]] = {
    "tips": ("needle/tip", 3, lambda m: _xyz(m.point)),
    "tip_covariances": ("needle/tip_pose", 9, _tip_covariance),
    "truth": ("sim/tip_pose", 7, lambda m: _pose(m.pose)),
    "estimate": ("needle/estimate", 7, lambda m: _pose(m.pose.pose)),
    "estimate_covariances": ("needle/estimate", 36, lambda m: m.pose.covariance),
    "reduced_state": ("needle/reduced_state", 3, lambda m: _xyz(m.vector)),
    "joints": ("joint_states", 2, lambda m: _joints(m.name, m.position)),
    "control_input": ("needle/control_input", 3, lambda m: _xyz(m.vector)),
    "commands": ("device/joint_trajectory", 2, _command),
    "holds": ("device/hold", 2, _hold),
}
"""Topic, row length and row function of each series; the function returns None for no row."""
