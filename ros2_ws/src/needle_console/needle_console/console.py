"""console as a component: shows the rig on web pages, and publishes the commands given there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.page_session import OWNER, Mode, PageHold
from needle_console.view.advice import Button
from needle_console.view.camera_view import SIDES
from needle_console.view.rig_picture import RigPicture
from needle_console.view.snapshot import Array, Snapshot
from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    IMAGES_BEST_EFFORT,
    LATCHED,
    Actions,
    Answer,
    Call,
    Component,
    Diagnose,
    Exit,
    Input,
    Listen,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    Publish,
    Send,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import HoldSession
from needle_core.retraction import Retraction
from needle_core.rotations import received_rotation
from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_tracker.optics.calibration import pose_matrix
from needle_tracker.sources.image_encodings import decoded

PAGE = "page"
"""Name of the port."""
DEVICE_STATUS, CONTROLLER_STATUS = "device/status", "needle/controller_status"
CALLS: Mapping[Button, Call] = {
    Button.CONFIRM: Call("device/confirm_needle_out", True),
    Button.HOME: Call("device/home"),
    Button.ENABLE: Call("device/enable", True),
    Button.SWITCH_OFF: Call("device/enable", False),
    Button.START: Call("plane_controller/start"),
    Button.RESET: Call("device/reset"),
    Button.STOP: Call("device/stop"),
}
"""Service call of each button."""
_IMAGES = {side: f"stereo/{side}/image_raw" for side in SIDES}
_HOLD, _PLANE, _POINT, _RIG = "device/hold", "target_plane", "target_point", "rig"
_PROPOSED_TARGET = "needle/proposed_target"
_SHOW_PERIOD, _CHECK_PERIOD = 0.1, 1.0
_HOLD_SERVER_TIMEOUT = 1.0
"""Time after which the hold's server, which reports at 12 Hz or more, counts as failed [s]."""
_VIEW_TIMEOUT = 2.0
"""Time within which an open page requests its views again [s]."""
_LAG_INCREASE = 0.05
"""Increase of the lag between two reports at which a simulation is too slow [s]."""


# ---- events from the port, in addition to Button, Pose, Point and Log ----------------------------


@dataclasses.dataclass(frozen=True)
class HoldRequest:
    """Hold of the pages, and the number of refusals of each kind by the hold's server."""

    hold: PageHold
    refusals: Mapping[str, int] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class ViewRequest:
    """Request of a page for a camera view."""


@dataclasses.dataclass(frozen=True)
class SimulationLag:
    """Lag of a simulation behind the clock [s]."""

    seconds: float


# ---- updates to the port, in addition to Snapshot -----------------------------------------------


@dataclasses.dataclass(frozen=True)
class CameraImage:
    """Grey image of a camera, shape (height, width)."""

    side: str
    image: NDArray[np.uint8]


PageEvent = HoldRequest | ViewRequest | SimulationLag | Button | m.Pose | m.Point | Log
PageUpdate = Snapshot | CameraImage


class Console(Component):
    """Shows the rig on web pages, and publishes the commands given there.

    Parameters
    ----------
    settings : ConsoleParameters
        The node's parameters.
    """

    name = OWNER

    def __init__(self, settings: ConsoleParameters) -> None:
        self.settings = settings
        self._picture = RigPicture()
        self._retraction = Retraction()
        self._session = HoldSession(OWNER)
        self._hold_at = -math.inf
        self._refusals: Mapping[str, int] = {}
        self._viewed_at = -math.inf
        self._lag = 0.0
        self.inputs = (
            Input(DEVICE_STATUS, DeviceStatus, self._on_device, LATCHED),
            Input(CONTROLLER_STATUS, ControllerStatus, self._on_controller, LATCHED),
            Input("joint_states", m.JointState, self._on_joints),
            Input("needle/tip_pose", m.PoseWithCovariance, self._on_tip),
            Input("needle/estimate", m.PoseWithCovariance, self._on_estimate),
            Input(_PLANE, m.Pose, self._on_plane, LATCHED),
            Input(_PROPOSED_TARGET, m.Point, self._on_proposal),
            Input("/diagnostics", m.Diagnostics, self._on_health),
            *(
                Input(topic, m.Image, partial(self._on_image, side), IMAGES_BEST_EFFORT, lazy=True)
                for side, topic in _IMAGES.items()
            ),
        )
        self.outputs = (
            Output(_HOLD, m.HoldState, BEST_EFFORT),
            Output(_PLANE, m.Pose, LATCHED),
            Output(_POINT, m.Point, LATCHED),
        )
        self.ports = (Port(PAGE, self._on_page),)
        self.timers = (Timer(_SHOW_PERIOD, self._show), Timer(_CHECK_PERIOD, self._check))

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Discard the status of a controller that has ended.

        A retraction waits for the end of steering, so a controller that was killed during steering
        must not block it.
        """
        if CONTROLLER_STATUS not in peers.publishers:
            self._picture.clear_controller()
        return ()

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Show the answer of a service."""
        refused = "refused: " if answer.answered and not answer.success else ""
        self._picture.set_answer(f"{answer.service}: {refused}{answer.text}")
        return ()

    def on_stop(self, at: Moment) -> Actions:
        """Release the hold, and exit."""
        yield self._publish_hold(at, pressed=False)
        yield Exit(0)

    # ---- the page -------------------------------------------------------------------------------

    def _on_page(self, events: Sequence[PageEvent], at: Moment) -> Actions:
        requests = [event for event in events if isinstance(event, HoldRequest)]
        for event in events:
            match event:
                case HoldRequest(PageHold(pressed=True)) if event is not requests[-1]:
                    # An earlier press in the batch is outdated; a release always counts.
                    continue
                case HoldRequest():
                    yield from self._on_hold(event, at)
                case Button():
                    yield CALLS[event]
                case m.Pose():
                    yield Publish(_PLANE, event)
                case m.Point():
                    yield Publish(_POINT, event)
                case Log():
                    yield event
                case ViewRequest():
                    self._viewed_at = at.steady
                    yield from (Listen(topic, True) for topic in _IMAGES.values())
                case SimulationLag(seconds):
                    self._on_lag(seconds, at)

    def _on_hold(self, request: HoldRequest, at: Moment) -> Actions:
        was_silent = at.steady - self._hold_at > _HOLD_SERVER_TIMEOUT
        self._hold_at, self._refusals = at.steady, request.refusals
        rig, hold = self._picture.latest(), request.hold
        order = self._retraction.update(
            hold.pressed and hold.mode is Mode.RETRACT,
            at.steady,
            steering=rig.controller is not None and rig.controller.is_steering,
            hold_counts=rig.device is not None and rig.device.is_idle_for(OWNER),
        )
        inserts = hold.pressed and hold.mode is Mode.INSERT
        yield self._publish_hold(at, pressed=inserts or order.press, speed=hold.speed)
        yield from map(Call, order.calls)
        if was_silent:
            yield from self._check(at)

    def _publish_hold(self, at: Moment, *, pressed: bool, speed: float = 0.0) -> Publish:
        return Publish(_HOLD, self._session.next_message(at.stamp_ns, pressed=pressed, speed=speed))

    def _on_lag(self, seconds: float, at: Moment) -> None:
        if seconds - self._lag >= _LAG_INCREASE:
            text = f"this computer is too slow, {seconds:.1f} s behind the clock"
            self._picture.set_health("simulation", bad=True, message=text, now=at.steady)
        self._lag = seconds

    def _show(self, at: Moment) -> Actions:
        yield Send(PAGE, (self._picture.snapshot(at.steady),))

    def _check(self, at: Moment) -> Actions:
        served = at.steady - self._hold_at <= _HOLD_SERVER_TIMEOUT
        message = "served" if served else "the hold's server does not answer"
        counts = {f"refused {reason}": str(count) for reason, count in self._refusals.items()}
        level = Level.OK if served else Level.ERROR
        yield Diagnose("hold", Diagnostic(level, message, counts))
        if at.steady - self._viewed_at > _VIEW_TIMEOUT:
            yield from (Listen(topic, False) for topic in _IMAGES.values())

    # ---- the rig --------------------------------------------------------------------------------

    def _on_device(self, message: DeviceStatus, at: Moment) -> Actions:
        self._picture.set_device(message)
        return ()

    def _on_controller(self, message: ControllerStatus, at: Moment) -> Actions:
        self._picture.set_controller(message)
        return ()

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        positions = dict(zip(message.names, message.positions, strict=False))
        insertion, rotation = (
            positions.get(name, math.nan) for name in (m.INSERTION_JOINT, m.ROTATION_JOINT)
        )
        self._picture.set_joints(insertion, rotation, at.steady)
        return ()

    def _on_tip(self, message: m.PoseWithCovariance, at: Moment) -> Actions:
        if message.frame_id == _RIG:
            self._picture.set_tip(*_position(message), at.steady)
        return ()

    def _on_estimate(self, message: m.PoseWithCovariance, at: Moment) -> Actions:
        if message.frame_id == _PLANE:
            self._picture.add_estimate(*_position(message))
        return ()

    def _on_plane(self, message: m.Pose, at: Moment) -> Actions:
        rotation = received_rotation(message.orientation)
        if message.frame_id == _RIG and rotation is not None:
            self._picture.set_plane(pose_matrix(rotation, message.position))
        return ()

    def _on_proposal(self, message: m.Point, at: Moment) -> Actions:
        self._picture.set_proposal(message.position if message.frame_id == _RIG else None)
        return ()

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        for status in message.statuses:
            bad = status.level in (Level.WARN, Level.ERROR)
            part = ": ".join(filter(None, (status.source, status.part)))
            self._picture.set_health(part, bad=bad, message=status.text, now=at.steady)
        return ()

    def _on_image(self, side: str, message: m.Image, at: Moment) -> Actions:
        image = decoded(message, side).pixels
        if image is not None:
            yield Send(PAGE, (CameraImage(side, np.ascontiguousarray(image)),))


def _position(message: m.PoseWithCovariance) -> tuple[Array, Array]:
    """Return a pose's position and its covariance, shapes (3,) and (3, 3), unchecked."""
    covariance = np.asarray(message.covariance, dtype=float).reshape(6, 6)
    return np.array(message.position), covariance[:3, :3]
