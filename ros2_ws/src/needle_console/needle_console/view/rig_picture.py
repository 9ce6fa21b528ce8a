"""Collection of the rig's messages into snapshots of its state."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_console.view.snapshot import Array, MeasuredTip, Snapshot, TrackPoint, stop_reason
from needle_core.diagnostics import sanitize
from needle_core.messages import Vector3
from needle_core.status_messages import ControllerStatus, DeviceStatus

# Estimates that are closer together than this are merged [m].
SPACING = 2.5e-4
MAX_POINTS = 1000
JOINTS_TIMEOUT = 1.0
# Nodes report their health once a second; an older warning is outdated [s].
_WARNING_TIMEOUT = 3.0
_MAX_WARNINGS = 6
_SAME_OFFSET = 1e-6


class RigPicture:
    """State of the rig from its messages.

    All times are monotonic [s].
    """

    def __init__(self) -> None:
        self._latest = Snapshot()
        self._joints_at = -math.inf
        self._tip_at = -math.inf
        self._lost_since: float | None = None
        self._sent_plane: Array | None = None
        self._track: list[TrackPoint] = []
        self._warnings: dict[str, tuple[str, float]] = {}

    def snapshot(self, now: float) -> Snapshot:
        """Return the state of the rig at `now`."""
        latest = self._latest
        joints_count = now - self._joints_at <= JOINTS_TIMEOUT
        fresh = [text for text, at in self._warnings.values() if now - at <= _WARNING_TIMEOUT]
        return dataclasses.replace(
            latest,
            insertion=latest.insertion if joints_count else math.nan,
            rotation=latest.rotation if joints_count else math.nan,
            tip=latest.tip and dataclasses.replace(latest.tip, age=now - self._tip_at),
            tip_lost_for=0.0 if self._lost_since is None else now - self._lost_since,
            track=tuple(self._track),
            warnings=tuple(fresh[:_MAX_WARNINGS]),
        )

    def latest(self) -> Snapshot:
        """Return the last status of device and controller; all other fields may be outdated."""
        return self._latest

    def set_device(self, state: DeviceStatus) -> None:
        """Set the status of the device."""
        before = self._latest.device
        if before is not None and "(hold_new_press)" in state.reason:
            # The press continues; the previous status has the reason why it no longer counts.
            state = dataclasses.replace(state, reason=stop_reason(before) or state.reason)
        self._update(device=state)

    def set_controller(self, state: ControllerStatus) -> None:
        """Set the status of the controller; a new start begins a new track."""
        before = self._latest.controller
        if before is not None and state.starts != before.starts:
            self._track.clear()
        self._latest = dataclasses.replace(
            self._latest, controller=state, T_rig_plane=self._plane(state.target_offset_m)
        )

    def clear_controller(self) -> None:
        """Discard the status of a controller that has ended."""
        self._update(controller=None)

    def set_joints(self, insertion: float, rotation: float, now: float) -> None:
        """Set the joints [m], [rad]; values that are not finite are ignored."""
        if math.isfinite(insertion) and math.isfinite(rotation):
            self._joints_at = now
            self._update(insertion=insertion, rotation=rotation)

    def set_tip(self, position: Array, covariance: Array, now: float) -> None:
        """Set the measured tip; an infinite covariance means that no tip was found.

        Parameters
        ----------
        position : ndarray, shape (3,)
            Position in `rig` [m].
        covariance : ndarray, shape (3, 3)
            Covariance of the position [m^2].
        now : float
            Time of arrival [s].
        """
        if np.isfinite(position).all() and np.isfinite(covariance).all():
            self._tip_at = now
            self._lost_since = None
            self._update(tip=MeasuredTip(position, covariance, 0.0))
        elif self._lost_since is None:
            self._lost_since = now

    def add_estimate(self, position: Array, covariance: Array) -> None:
        """Add an estimate of the tip in the frame of the target plane.

        Parameters
        ----------
        position : ndarray, shape (3,)
            Coordinates r1, y and z [m].
        covariance : ndarray, shape (3, 3)
            Covariance of the position [m^2].
        """
        if not (np.isfinite(position).all() and np.isfinite(covariance).all()):
            return
        depth = self._latest.insertion
        if not math.isfinite(depth):
            return
        rotation, origin = self._latest.T_rig_plane[:3, :3], self._latest.T_rig_plane[:3, 3]
        point = TrackPoint(
            depth=depth,
            r1=float(position[0]),
            sigma=math.sqrt(max(float(covariance[0, 0]), 0.0)),
            position=rotation @ position + origin,
            covariance=rotation @ covariance @ rotation.T,
        )
        # Replace estimates at the same depth, and deeper ones after a retraction.
        while self._track and self._track[-1].depth > depth - SPACING:
            self._track.pop()
        self._track.append(point)
        del self._track[:-MAX_POINTS]

    def set_plane(self, T_rig_plane: Array) -> None:  # noqa: N803
        """Set the pose of a `target_plane` message, shape (4, 4)."""
        if not np.isfinite(T_rig_plane).all():
            return
        self._sent_plane = T_rig_plane
        state = self._latest.controller
        if state is not None:
            plane = self._plane(state.target_offset_m)
            self._latest = dataclasses.replace(self._latest, T_rig_plane=plane)

    def set_proposal(self, point: Vector3 | None) -> None:
        """Set the target point that a planner proposes, in `rig` [m]; None if it is withdrawn."""
        self._update(proposed_point=point)

    def set_health(self, name: str, *, bad: bool, message: str, now: float) -> None:
        """Set one status from /diagnostics; `name` is `node: part`, `bad` marks a warning."""
        self._warnings.pop(name, None)
        if bad:
            self._warnings[name] = (f"{sanitize(name)}: {sanitize(message, 160)}", now)
        while len(self._warnings) > MAX_POINTS:
            del self._warnings[next(iter(self._warnings))]

    def set_answer(self, text: str) -> None:
        """Set the answer of the last service call."""
        self._update(answer=sanitize(text, 200))

    def _update(self, **changes: object) -> None:
        self._latest = dataclasses.replace(self._latest, **changes)  # type: ignore[arg-type]

    def _plane(self, offset: float | None) -> Array:
        """Return the current plane: the sent one if the controller accepted it, or the default."""
        sent = self._sent_plane
        if sent is not None and (
            offset is None or abs(float(sent[:3, 0] @ sent[:3, 3]) - offset) < _SAME_OFFSET
        ):
            return sent
        plane = np.eye(4)
        plane[0, 3] = 0.0 if offset is None else offset
        return plane
