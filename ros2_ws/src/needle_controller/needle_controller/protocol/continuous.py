"""Continuous insertion: the path ahead, made anew from every step length, sent anew with every tip.

A path says where the base is turned at each insertion, whatever the speed. Its knots do not depend
on when it is sent: where a tip was used, and one step length on, by where the turn that the law
wants is done; from there on the base is not turned before the next tip was used. So the time from
an exposure to the answer costs no turn, it only bends the way to it.

A tip is used where the needle has gone in by a step length since the last used one, and at the end
of the way. Others say that the camera lives and renew the path's stamp: at rest, or slowly, they
are measurements of one place, whose errors may be one error, so that nothing depends on how many
there are.
"""

from __future__ import annotations

import math

from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.next_step import next_step
from needle_controller.protocol.steering import Steering
from needle_controller.protocol.steering_types import (
    Action,
    Awaiting,
    SendPath,
    SendStep,
    StartReply,
    SteeringState,
)
from needle_controller.protocol.tip_gate import AcceptedTip
from needle_core.component import Log
from needle_core.status_messages import DeviceStatus

_AS_GOOD_AS_A_STEP = 1.0 - 1e-3
_AT_END = 1e-5
"""Insertion short of the end of the way that counts as there [m]: an axis rests beside it."""
_PIECES = 4
"""So finely a step length is followed where rotation was not in proportion to insertion."""


def make_steering(settings: SteeringSettings) -> Steering:
    """Return the protocol that the settings ask for."""
    continuous = settings.insertion == "continuous"
    return ContinuousSteering(settings) if continuous else Steering(settings)


class PathAhead:
    """Knots of the path from one used tip on.

    Parameters
    ----------
    joints : JointSample
        At the used tip.
    command : SteeringCommand
        What the law wants.
    settings : SteeringSettings
        Step length, depth and speed.
    slowly : bool
        Whether to go at half the speed.
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
        step = next_step(joints.stamp_ns, joints, command, settings, slowly=slowly)
        self.is_done = step is None
        self.start = joints
        # Where the turn is done; of a needle that is there nothing is left.
        self._knot = step or SendStep(joints.stamp_ns, joints.insertion, joints.rotation, 0.0)
        self.end = settings.depth
        if command.insertion_left is not None:
            self.end = min(self.end, joints.insertion + float(command.insertion_left))
        self._speed = (
            math.inf if step is None else (step.insertion - joints.insertion) / (step.duration)
        )

    def points(self, insertion: float) -> tuple[tuple[float, float, float], ...]:
        """Return the path for a needle that is at an insertion [m], as `SendPath` has it."""
        start, knot = self.start, self._knot
        end = max(min(insertion + self._settings.horizon, self.end), knot.insertion)
        # A needle that went back begins where it is: a path never begins ahead of the needle.
        begin = min(start.insertion, insertion)
        places = [(begin, start.rotation), (knot.insertion, knot.rotation)]
        if end > knot.insertion:
            places.append((end, knot.rotation))
        return tuple((at, rotation, (at - begin) / self._speed) for at, rotation in places)


class ContinuousSteering(Steering):
    """The protocol of one needle that goes on while a person holds.

    States, and what is refused, are those of stepwise insertion.
    """

    _goes_on = True

    def __init__(self, settings: SteeringSettings) -> None:
        super().__init__(settings)
        self._ahead: PathAhead | None = None
        # Stamp of the newest path that was on its way when a refusal was heard [ns].
        self._refusal_known_ns = 0

    def on_start(self) -> tuple[StartReply, list[Action]]:
        """Begin steering, or say why not."""
        self._refusal_known_ns = 0
        reply, actions = super().on_start()
        if not self.control.started:
            self._ahead = None
        return reply, actions

    def on_result(self, stamp_ns: int, text: str, sent_ns: int = 0) -> list[Action]:
        """Take the driver's answer to a path; newer ones may be on their way.

        Those that were sent before a refusal was heard say nothing new.

        Parameters
        ----------
        stamp_ns : int
            The command's stamp [ns].
        text : str
            "succeeded", "replaced", or why not.
        sent_ns : int
            When the device sent it; unused.
        """
        if not self._steering or not self._refusal_known_ns < stamp_ns <= self.command_ns:
            return []
        if text in {"succeeded", "replaced"}:
            self._failed.forget()
            return []
        self._refusal_known_ns = self.command_ns
        return self._take_abort("path", "path", text)

    def on_recorded_step(self, stamp_ns: int, end: JointSample) -> None:
        """Do nothing: a path depends on joints, not on where the one before has led."""

    def on_device(self, status: DeviceStatus) -> list[Action]:
        """Take the driver's state."""
        actions = super().on_device(status)
        if self._steering and self.awaiting is Awaiting.TIP and not status.hold_owner:
            self.awaiting = Awaiting.HOLD
        return actions

    def _go_on_from(self, accepted: AcceptedTip) -> list[Action]:
        self.patience.restart()
        actions: list[Action] = []
        tip, joints, ahead = accepted.tip, accepted.joints, self._ahead
        if ahead is None or self._is_due(joints, ahead):
            way: list[JointSample] = []
            if ahead is not None:
                spacing = self.settings.step_length / _PIECES
                way = self.intake.joints.between(ahead.start, joints, spacing)
                self.step += 1
            update, actions = self._use(accepted, way)
            if update is None:
                return actions
            slowly = self.trust.is_doubtful
            ahead = self._ahead = PathAhead(joints, update.command, self.settings, slowly=slowly)
            if ahead.is_done:
                return actions + self._end(update, joints)
        elif self.state is SteeringState.WAITING_FOR_TIP:
            self.state, self.reason = SteeringState.STEERING, ""
            actions.append(Log("info", "STEERING: a good tip came"))
        return actions + self._send_path(SendPath(tip.stamp_ns, ahead.points(joints.insertion)))

    def _is_due(self, joints: JointSample, ahead: PathAhead) -> bool:
        gone = joints.insertion - ahead.start.insertion
        return (
            gone >= _AS_GOOD_AS_A_STEP * self.settings.step_length
            or joints.insertion >= ahead.end - _AT_END
        )

    def _send_path(self, path: SendPath) -> list[Action]:
        if self._device is None or not self._device.hold_owner:
            self.awaiting = Awaiting.HOLD
            return []
        self.command_ns = path.stamp_ns
        return [path]
