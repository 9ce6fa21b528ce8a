"""Continuous insertion: each tip renews a path ahead, which is recomputed every step length.

A path gives the base's rotation over insertion, whatever the speed. Its points do not depend on
the time at which it is sent: it begins where a tip was used; after one step length, the rotation
that the law commands is complete; beyond that, the base does not turn until the next tip is used.
So the delay from exposure to command loses no rotation; it only changes the path to it.

A tip is used once the needle has advanced by a step length since the last used one, and at the end
of the path. Other tips show that the camera works and renew the path's stamp. At rest or at low
speed, they measure the same position and their errors may be equal, so nothing depends on their
number.
"""

from __future__ import annotations

import math

from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import (
    Action,
    Awaiting,
    SendPath,
    SendStep,
    StartReply,
    SteeringState,
    next_step,
)
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering import Steering
from needle_controller.protocol.tip_checks import AcceptedTip
from needle_core.component import Log
from needle_core.status_messages import DeviceStatus

_STEP_SHARE = 1.0 - 1e-3
"""Share of a step length after which a tip is used."""
_END_TOLERANCE = 1e-5
"""Distance from the end of the path at which it counts as reached [m]: an axis rests near it."""
_SAMPLES_PER_STEP = 4
"""Intermediate joint samples per step length, where rotation was not proportional to insertion."""


def make_steering(settings: SteeringSettings) -> Steering:
    """Return the protocol for stepwise or continuous insertion."""
    continuous = settings.insertion == "continuous"
    return ContinuousSteering(settings) if continuous else Steering(settings)


class PathAhead:
    """Path ahead of one used tip.

    Parameters
    ----------
    joints : JointSample
        Joint positions at the used tip.
    command : SteeringCommand
        Output of the control law.
    settings : SteeringSettings
        Step length, depth and speed.
    slowly : bool
        Whether to move at half the speed.
    """

    def __init__(
        self,
        joints: JointSample,
        command: SteeringCommand,
        settings: SteeringSettings,
        *,
        slowly: bool,
    ) -> None:
        self._settings = settings
        step = next_step(joints, command, settings, slowly=slowly)
        self.is_done = step is None
        self.start = joints
        # End of the rotation; at the target, no motion is left.
        self._knot = step or SendStep(joints.stamp_ns, joints.insertion, joints.rotation, 0.0)
        self.end = settings.depth
        if command.insertion_left is not None:
            self.end = min(self.end, joints.insertion + float(command.insertion_left))
        self._speed = (
            math.inf if step is None else (step.insertion - joints.insertion) / step.duration
        )

    def points(self, insertion: float) -> tuple[tuple[float, float, float], ...]:
        """Return the points of `SendPath` for a needle at an insertion [m]."""
        start, knot = self.start, self._knot
        end = max(min(insertion + self._settings.horizon, self.end), knot.insertion)
        # A path never begins ahead of the needle, even if the needle moved back.
        begin = min(start.insertion, insertion)
        corners = [(begin, start.rotation), (knot.insertion, knot.rotation)]
        if end > knot.insertion:
            corners.append((end, knot.rotation))
        return tuple((at, rotation, (at - begin) / self._speed) for at, rotation in corners)


class ContinuousSteering(Steering):
    """Protocol of one needle that moves continuously while the hold lasts.

    States and rejections are those of stepwise insertion.
    """

    _moves_while_awaiting_tip = True

    def __init__(self, settings: SteeringSettings) -> None:
        super().__init__(settings)
        self._ahead: PathAhead | None = None
        # Stamp of the newest path that had been sent when the last abort arrived [ns].
        self._abort_known_ns = 0

    def on_start(self) -> tuple[StartReply, list[Action]]:
        """Start steering, or reply why it cannot start."""
        self._abort_known_ns = 0
        reply, actions = super().on_start()
        if not self.control.started:
            self._ahead = None
        return reply, actions

    def on_result(self, stamp_ns: int, text: str, sent_ns: int = 0) -> list[Action]:
        """Handle the driver's answer to a path, after which newer paths may have been sent.

        Aborts of paths sent before an earlier abort arrived are ignored.

        Parameters
        ----------
        stamp_ns : int
            Stamp of the command [ns].
        text : str
            "succeeded", "replaced", or the reason for the abort.
        sent_ns : int
            Time at which the device sent the answer; unused.
        """
        if not self.is_steering or not self._abort_known_ns < stamp_ns <= self.command_ns:
            return []
        if text in {"succeeded", "replaced"}:
            self._failures.reset()
            return []
        self._abort_known_ns = self.command_ns
        return self._on_abort("path", "path", text)

    def on_device(self, status: DeviceStatus) -> list[Action]:
        """Handle the driver's status."""
        actions = super().on_device(status)
        if self.is_steering and self.awaiting is Awaiting.TIP and not status.hold_owner:
            self.awaiting = Awaiting.HOLD
        return actions

    def _on_accepted_tip(self, accepted: AcceptedTip) -> list[Action]:
        self.watchdog.restart()
        actions: list[Action] = []
        tip, joints, ahead = accepted.tip, accepted.joints, self._ahead
        if ahead is None or self._is_due(joints, ahead):
            intermediate: list[JointSample] = []
            if ahead is not None:
                spacing = self.settings.step_length / _SAMPLES_PER_STEP
                intermediate = self.tips.joints.between(ahead.start, joints, spacing)
                self.step += 1
            update, actions = self._update_control(accepted, intermediate)
            if update is None:
                return actions
            slowly = self.confidence.is_doubtful
            ahead = self._ahead = PathAhead(joints, update.command, self.settings, slowly=slowly)
            if ahead.is_done:
                return actions + self._finish(update, joints)
        elif self.state is SteeringState.WAITING_FOR_TIP:
            self.state, self.reason = SteeringState.STEERING, ""
            actions.append(Log("info", "STEERING: received a good tip"))
        return actions + self._send_path(SendPath(tip.stamp_ns, ahead.points(joints.insertion)))

    def _is_due(self, joints: JointSample, ahead: PathAhead) -> bool:
        advanced = joints.insertion - ahead.start.insertion
        return (
            advanced >= _STEP_SHARE * self.settings.step_length
            or joints.insertion >= ahead.end - _END_TOLERANCE
        )

    def _send_path(self, path: SendPath) -> list[Action]:
        if self._device is None or not self._device.hold_owner:
            self.awaiting = Awaiting.HOLD
            return []
        self.command_ns = path.stamp_ns
        return [path]
