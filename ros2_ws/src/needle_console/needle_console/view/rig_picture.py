"""Collects what is heard of the rig and hands out snapshots."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_console.view.snapshot import Array, CoursePoint, SeenTip, Snapshot, trouble_of
from needle_core.diagnostics import sanitize
from needle_core.status_messages import ControllerStatus, DeviceStatus

# Estimates that are closer together are drawn as one [m].
SPACING = 2.5e-4
MOST_POINTS = 1000
JOINTS_COUNT_FOR = 1.0
# Health is told once a second; who is silent for longer has nothing to say any more [s].
_TROUBLE_COUNTS_FOR = 3.0
_MOST_TROUBLES = 6
_SAME_OFFSET = 1e-6


class RigPicture:
    """The rig as heard up to now.

    All times are readings of one steady clock [s].
    """

    def __init__(self) -> None:
        self._told = Snapshot()
        self._joints_at = -math.inf
        self._tip_at = -math.inf
        self._lost_since: float | None = None
        self._heard_plane: Array | None = None
        self._course: list[CoursePoint] = []
        self._troubles: dict[str, tuple[str, float]] = {}

    def snapshot(self, now: float) -> Snapshot:
        """Return the rig as it is known at `now`."""
        told = self._told
        joints_count = now - self._joints_at <= JOINTS_COUNT_FOR
        fresh = [text for text, at in self._troubles.values() if now - at <= _TROUBLE_COUNTS_FOR]
        return dataclasses.replace(
            told,
            insertion=told.insertion if joints_count else math.nan,
            rotation=told.rotation if joints_count else math.nan,
            tip=told.tip and dataclasses.replace(told.tip, age=now - self._tip_at),
            tip_lost_for=0.0 if self._lost_since is None else now - self._lost_since,
            course=tuple(self._course),
            troubles=tuple(fresh[:_MOST_TROUBLES]),
        )

    def states(self) -> Snapshot:
        """Return what device and controller last said; all else may be old."""
        return self._told

    def see_device(self, state: DeviceStatus) -> None:
        """Take what the device says."""
        before = self._told.device
        if before is not None and "(hold_new_press)" in state.reason:
            # Only says that the press goes on; the status before said why it no longer counts.
            state = dataclasses.replace(state, reason=trouble_of(before) or state.reason)
        self._tell(device=state)

    def see_controller(self, state: ControllerStatus) -> None:
        """Take what the controller says; a new start begins a new course."""
        before = self._told.controller
        if before is not None and state.starts != before.starts:
            self._course.clear()
        self._told = dataclasses.replace(
            self._told, controller=state, T_rig_plane=self._plane(state.target_offset_m)
        )

    def lose_controller(self) -> None:
        """Take that there is no controller any more: what it said last holds no longer."""
        self._tell(controller=None)

    def see_joints(self, insertion: float, rotation: float, now: float) -> None:
        """Take the joints [m], [rad]; numbers that are none are left out."""
        if math.isfinite(insertion) and math.isfinite(rotation):
            self._joints_at = now
            self._tell(insertion=insertion, rotation=rotation)

    def see_tip(self, position: Array, covariance: Array, now: float) -> None:
        """Take an answer of the cameras; an infinite covariance says that no tip was found.

        Parameters
        ----------
        position : ndarray, shape (3,)
            In `rig` [m].
        covariance : ndarray, shape (3, 3)
            Of the position [m^2].
        now : float
            When it came.
        """
        if np.isfinite(position).all() and np.isfinite(covariance).all():
            self._tip_at = now
            self._lost_since = None
            self._tell(tip=SeenTip(position, covariance, 0.0))
        elif self._lost_since is None:
            self._lost_since = now

    def see_estimate(self, position: Array, covariance: Array) -> None:
        """Take an estimate of the tip in the frame of the target plane.

        Parameters
        ----------
        position : ndarray, shape (3,)
            r1, y and z [m].
        covariance : ndarray, shape (3, 3)
            Of the position [m^2].
        """
        if not (np.isfinite(position).all() and np.isfinite(covariance).all()):
            return
        depth = self._told.insertion
        if not math.isfinite(depth):
            return
        rotation, origin = self._told.T_rig_plane[:3, :3], self._told.T_rig_plane[:3, 3]
        point = CoursePoint(
            depth=depth,
            r1=float(position[0]),
            sigma=math.sqrt(max(float(covariance[0, 0]), 0.0)),
            position=rotation @ position + origin,
            covariance=rotation @ covariance @ rotation.T,
        )
        # Of estimates at one place, and where the needle was drawn back, the last counts.
        while self._course and self._course[-1].depth > depth - SPACING:
            self._course.pop()
        self._course.append(point)
        del self._course[:-MOST_POINTS]

    def see_plane(self, T_rig_plane: Array) -> None:  # noqa: N803
        """Take the pose that somebody sent as `target_plane`, shape (4, 4)."""
        if not np.isfinite(T_rig_plane).all():
            return
        self._heard_plane = T_rig_plane
        state = self._told.controller
        if state is not None:
            plane = self._plane(state.target_offset_m)
            self._told = dataclasses.replace(self._told, T_rig_plane=plane)

    def see_health(self, name: str, *, bad: bool, message: str, now: float) -> None:
        """Take one line of /diagnostics: `node: part`, whether it warns, and what it says."""
        self._troubles.pop(name, None)
        if bad:
            self._troubles[name] = (f"{sanitize(name)}: {sanitize(message, 160)}", now)
        while len(self._troubles) > MOST_POINTS:
            del self._troubles[next(iter(self._troubles))]

    def see_answer(self, text: str) -> None:
        """Take what a service call was answered."""
        self._tell(answer=sanitize(text, 200))

    def _tell(self, **news: object) -> None:
        self._told = dataclasses.replace(self._told, **news)  # type: ignore[arg-type]

    def _plane(self, offset: float | None) -> Array:
        """Return the plane in force: what was sent if the controller took it, else the default."""
        heard = self._heard_plane
        if heard is not None and (
            offset is None or abs(float(heard[:3, 0] @ heard[:3, 3]) - offset) < _SAME_OFFSET
        ):
            return heard
        plane = np.eye(4)
        plane[0, 3] = 0.0 if offset is None else offset
        return plane
