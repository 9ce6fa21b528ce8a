"""The step protocol: when the needle is moved, by what data, and when not.

States: IDLE -> STEERING <-> WAITING_FOR_TIP -> DONE | FAULT. Events come in, actions go out; time
is an argument. What is sent depends on stamps, never on the order in which topics arrived.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from needle_controller.model.reachability import Reachability
from needle_controller.presets.own_parts import OwnPartError
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import Heard, JointSample
from needle_controller.protocol.next_step import next_step
from needle_controller.protocol.patience import Patience
from needle_controller.protocol.plane_control import ControlUpdate, PlaneControl
from needle_controller.protocol.retraction import RetractionWatch
from needle_controller.protocol.start_conditions import Situation, is_out, obstacle
from needle_controller.protocol.steering_types import (
    Action,
    Awaiting,
    PublishUpdate,
    SendStep,
    StartReply,
    SteeringState,
)
from needle_controller.protocol.step_watch import FailedSteps, Followed, StepWatch
from needle_controller.protocol.tip_gate import (
    AcceptedTip,
    RefusedTip,
    TipCovariance,
    TipMeasurement,
)
from needle_controller.protocol.tip_intake import TipIntake
from needle_controller.protocol.trust import Trust, trust_of
from needle_core.component import Log
from needle_core.status_messages import DeviceStatus

_STOPPED_DEVICE = ("FAULT", "ESTOPPED")
_DISABLED_DEVICE = ("UNCONFIGURED", "DISABLED")


class Steering:
    """The step protocol of one needle.

    Parameters
    ----------
    settings : SteeringSettings
        What estimator, law and protocol are made of; `configure` changes it.

    Attributes
    ----------
    control : PlaneControl
        Estimator and law.
    state, awaiting, reason : SteeringState, Awaiting, str
        Where the protocol is, what it needs to go on, and why or what is amiss.
    starts, step : int
        How often somebody has started it; steps done.
    rejection : str
        Why the last tip was refused; empty once one was used.
    watchdog_trips : int
        How often the steady clock, not data, decided.
    command_ns : int
        Stamp of the command sent last [ns]; 0: none yet.
    insertion, reach, trust : float, Reachability or None, Trust
        At the last used tip: insertion [m], reach of plane or point, trust in the estimate.
    intake : TipIntake
        Tips and joints.
    patience : Patience
        How long has been waited, and for what.
    """

    _goes_on = False
    """Whether the needle goes on while a tip is awaited."""

    def __init__(self, settings: SteeringSettings) -> None:
        self.settings = settings
        self.control = PlaneControl(settings, settings.plane())
        self.state = SteeringState.IDLE
        self.awaiting = Awaiting.NOTHING
        self.reason = "not started"
        self.starts = 0
        self.step = 0
        self.rejection = ""
        self.watchdog_trips = 0
        self.command_ns = 0
        self.insertion = 0.0
        self.reach: Reachability | None = None
        self.trust = Trust()
        self.intake = TipIntake()
        self._retraction = RetractionWatch()
        self._device: DeviceStatus | None = None
        self._ready_step: SendStep | None = None
        self._sent: SendStep | None = None
        self._followed: StepWatch | None = None
        self._failed = FailedSteps()
        self.patience = Patience()

    def configure(self, settings: SteeringSettings) -> None:
        """Go on with other settings; a given plane stays unless `target_offset` changes."""
        self.control.configure(settings)
        self.settings = settings

    def on_start(self) -> tuple[StartReply, list[Action]]:
        """Begin steering, or say why not."""
        joints = self.intake.joints.latest
        now = Situation(self._steering, self._device, joints, self._retraction.obstacle)
        why = obstacle(now, self.control, self.settings)
        if why:
            return StartReply(False, why), [Log("warning", f"not started: {why}")]
        if joints is not None and is_out(joints, self.settings):
            self.control.restart()
            self.intake.last = None
            self.step = 0
            self._retraction.begin(joints.insertion)
        self.state, self.reason = SteeringState.STEERING, ""
        self.starts += 1
        self._failed.forget()
        self.intake.want_any()
        return StartReply(True, "steering"), [Log("info", "steering"), *self._ask()]

    def on_stop(self) -> tuple[StartReply, list[Action]]:
        """Send no further step; one under way ends with the hold, or by itself."""
        if not self._steering:
            return StartReply(True, f"was not steering ({self.state.value})"), []
        return StartReply(True, "stopped"), self._leave(SteeringState.IDLE, "stopped", "info")

    def on_joints(self, sample: JointSample) -> list[Action]:
        """Take a sample of the joints."""
        before, complaint = self.intake.joints.latest, self.intake.joints.complaint
        heard = self.intake.joints.add(sample)
        if heard is Heard.DOUBTED and not complaint:
            return [Log("warning", self.intake.joints.complaint, "joints")]
        if heard in {Heard.DOUBTED, Heard.REPEATED}:
            return []
        actions = self.patience.hear()
        if heard is Heard.JUMPED and before is not None:
            actions += self._take_jump(before, sample)
        out_below = self.settings.needle_out_insertion
        tolerance = self.settings.retraction_tolerance
        if self._retraction.watch(sample.insertion, out_below=out_below, tolerance=tolerance):
            actions += self._end_by_retraction(sample)
        return actions + self._watch_step(sample) + self._use_tip()

    def on_tip(self, tip: TipMeasurement) -> list[Action]:
        """Take a measured tip: used, kept until all that belongs to it has come, or refused."""
        wanted = self._steering and self.awaiting is Awaiting.TIP
        refusal = self.intake.offer(tip, self.settings, steering=self._steering, wanted=wanted)
        return [*(self._refuse(refusal) if refusal is not None else ()), *self._use_tip()]

    def on_tip_pose(self, covariance: TipCovariance) -> list[Action]:
        """Take what a tip's source says of how well it knows the tip of the same stamp."""
        self.intake.covariances.append(covariance)
        return self._use_tip()

    def on_result(self, stamp_ns: int, text: str, sent_ns: int = 0) -> list[Action]:
        """Take the driver's answer to a command; answers to other commands are not ours.

        Parameters
        ----------
        stamp_ns : int
            The command's stamp [ns].
        text : str
            "succeeded", or why not.
        sent_ns : int
            When the device sent it, on its own clock [ns]; 0 where nobody knows.
        """
        if self._sent is None or stamp_ns != self._sent.stamp_ns:
            return []
        step, self._sent = self._sent, None
        if not self._steering:
            return []
        if text == "succeeded":
            self._followed = StepWatch(step, sent_ns)
            return [*self._ask(), *self._watch_step(None), *self._use_tip()]
        return self._take_abort("step", f"step {self.step + 1}", text)

    def on_recorded_step(self, stamp_ns: int, end: JointSample) -> None:
        """Take that a recorded device made another step: its command's stamp [ns], where it led."""
        if self._sent is not None:
            self._sent = SendStep(stamp_ns, end.insertion, end.rotation, self._sent.duration)

    def on_device(self, status: DeviceStatus) -> list[Action]:
        """Take the driver's state."""
        if not status.hold_owner:
            # Who lets go has not made a command fail, and who presses anew has looked.
            self._failed.forget()
        self._device = status
        actions = self.patience.hear()
        if not self._steering:
            return actions
        if status.state in _STOPPED_DEVICE:
            why = f"device is {status.state}: {status.why}"
            return actions + self._leave(SteeringState.FAULT, why, "error")
        if status.state in _DISABLED_DEVICE:
            return actions + self._leave(SteeringState.IDLE, f"device is {status.state}", "warning")
        if self.awaiting is Awaiting.HOLD and status.hold_owner:
            actions += self._ask()
        elif self.awaiting is Awaiting.DEVICE:
            actions += self._send()
        return actions

    def on_time(self, steady: float) -> list[Action]:
        """Watch the age of what is awaited, at a time of the steady clock [s]."""
        if not (self._steering and self.awaiting in {Awaiting.TIP, Awaiting.RESULT}):
            self.patience.restart()
            return []
        moving = self.awaiting is Awaiting.RESULT and self._is_moving()
        waited = self.patience.waited(steady, moving=moving)
        if self.awaiting is Awaiting.RESULT:
            return self._watch_result(waited, steady)
        return self._watch_tip(waited, steady)

    @property
    def _steering(self) -> bool:
        return self.state in {SteeringState.STEERING, SteeringState.WAITING_FOR_TIP}

    def _is_moving(self) -> bool:
        """Return whether the device says so, or the joints do since the last look."""
        has_moved = self.patience.has_moved(self.intake.joints.latest)
        return has_moved or (self._device is not None and self._device.state == "MOVING")

    def _watch_tip(self, waited: float, steady: float) -> list[Action]:
        actions: list[Action] = []
        if (refusal := self.intake.watch(steady, self.settings.tip_timeout)) is not None:
            self.watchdog_trips += 1
            actions = [*self._refuse(refusal), *self._use_tip()]
        if waited < self.settings.tip_timeout or self.state is SteeringState.WAITING_FOR_TIP:
            return actions
        self.state = SteeringState.WAITING_FOR_TIP
        self.watchdog_trips += 1
        self.reason = f"no good tip for {self.settings.tip_timeout:g} s"
        if self._followed is not None:
            self.reason = f"joint_states do not show the end of step {self.step + 1}"
        elif self.rejection:
            self.reason += f"; the last one was refused: {self.rejection}"
        return [*actions, Log("warning", f"WAITING_FOR_TIP: {self.reason}")]

    def _watch_result(self, waited: float, steady: float) -> list[Action]:
        """Give up on an answer that is lost; say so when the device says nothing at all."""
        timeout = self.settings.result_timeout
        if waited >= timeout:
            self.watchdog_trips += 1
            why = (
                f"no device/result for step {self.step + 1} in {timeout:g} s, and the device does "
                "not move: the command or its answer is lost"
            )
            return self._leave(SteeringState.FAULT, why, "error")
        return self.patience.notice_silence(steady, timeout)

    def _take_abort(self, kind: str, name: str, text: str) -> list[Action]:
        """Go on from a command that was aborted, unless too many were in a row."""
        actions: list[Action] = [Log("warning", f"{name} {text}", "abort")]
        self.reason = f"{kind} {text}"
        why = self._failed.aborted(text, moved=self.intake.has_moved)
        if why:
            return actions + self._leave(SteeringState.FAULT, why, "error")
        return actions + self._ask() + self._use_tip()

    def _ask(self) -> list[Action]:
        """Ask for a tip of the needle at rest, or for the hold that must come first."""
        self._ready_step = None
        if self._device is None or not self._device.hold_owner:
            self.awaiting = Awaiting.HOLD
            return []
        latest = self.intake.joints.latest
        if self._followed is None and latest is not None:
            # Wherever a motion ended, it was over by then.
            self.intake.want_after(latest.stamp_ns)
        self.awaiting = Awaiting.TIP
        self.patience.restart()
        return []

    def _watch_step(self, sample: JointSample | None) -> list[Action]:
        """Look whether the joints have followed the step that succeeded."""
        watch = self._followed
        if watch is None:
            return []
        if (followed := watch.look(self.intake.joints, sample)) is Followed.NOT_YET:
            return []
        self._followed = None
        self.intake.want_after(watch.end_ns)
        if followed is Followed.ARRIVED or sample is None:
            self.step += 1
            self._failed.forget()
            return []
        why, is_enough = self._failed.unfollowed(watch.step, sample)
        if is_enough:
            return self._leave(SteeringState.FAULT, why, "error")
        self.reason = why
        return [Log("warning", why, "unfollowed")]

    def _refuse(self, refusal: RefusedTip) -> list[Action]:
        self.rejection = refusal.text
        if self._steering:
            self.reason = f"tip refused: {refusal.text}"
        return [Log("warning", f"tip refused: {refusal.text}", f"tip {refusal.fault.value}")]

    def _use_tip(self) -> list[Action]:
        actions: list[Action] = []
        while self._steering and self.awaiting is Awaiting.TIP and self._followed is None:
            taken = self.intake.take(self.settings, moving=self._goes_on)
            if taken is None:
                break
            if isinstance(taken, AcceptedTip):
                actions += self._go_on_from(taken)
            else:
                actions += self._refuse(taken)
        return actions

    def _go_on_from(self, accepted: AcceptedTip) -> list[Action]:
        """Do what a good tip lets be done."""
        update, actions = self._use(accepted)
        if update is None:
            return actions
        stamp, joints, slowly = accepted.tip.stamp_ns, accepted.joints, self.trust.is_doubtful
        self._ready_step = next_step(stamp, joints, update.command, self.settings, slowly=slowly)
        if self._ready_step is None:
            return actions + self._end(update, joints)
        return actions + self._send()

    def _use(
        self, accepted: AcceptedTip, way: Sequence[JointSample] = ()
    ) -> tuple[ControlUpdate | None, list[Action]]:
        """Hand a tip to the estimator; None where no way on is clear, or another's part failed."""
        tip, joints = accepted.tip, accepted.joints
        self.rejection = ""
        self.insertion = joints.insertion
        try:
            update = self.control.update(tip.position, joints, accepted.covariance, way)
        except OwnPartError as error:
            return None, self._leave(SteeringState.FAULT, str(error), "error")
        self.reach = update.reach
        self.trust = trust_of(update.estimate)
        self.reason = "; ".join(update.estimate.warnings)
        actions: list[Action] = [PublishUpdate(tip.stamp_ns, update)]
        if self.state is SteeringState.WAITING_FOR_TIP:
            self.state = SteeringState.STEERING
            actions.append(Log("info", "STEERING: a good tip came"))
        if update.blocked:
            why = f"no way on from insertion {joints.insertion:.4g} m is clear of the obstacles"
            return None, [*actions, *self._leave(SteeringState.IDLE, why, "warning")]
        return update, actions

    def _end(self, update: ControlUpdate, joints: JointSample) -> list[Action]:
        self.trust = trust_of(update.estimate, update.missed)
        text = f"insertion {joints.insertion:.6g} m reached; {self.trust.summary}"
        return self._leave(SteeringState.DONE, text, "info")

    def _send(self) -> list[Action]:
        step, device = self._ready_step, self._device
        if step is None or device is None or not device.hold_owner:
            # The step was for a needle somebody held: ask anew when somebody does.
            self._ready_step = None
            self.awaiting = Awaiting.HOLD
            return []
        if device.state != "HOLDING":
            self.awaiting = Awaiting.DEVICE
            return []
        if self.intake.has_moved_on(self.settings.step_length):
            self._ready_step = None
            self.awaiting = Awaiting.TIP
            return self._use_tip()
        self._ready_step, self._sent = None, step
        self.command_ns = step.stamp_ns
        self.awaiting = Awaiting.RESULT
        self.patience.restart()
        return [step]

    def _take_jump(self, before: JointSample, sample: JointSample) -> list[Action]:
        """Take that the joints are in another place, or time, without a way there."""
        settings, gap = self.settings, (sample.stamp_ns - before.stamp_ns) * 1e-9
        tolerance = settings.retraction_tolerance
        if gap > 0.0 and sample.is_at(before, settings.step_length + tolerance, math.inf):
            # They were silent, no more.
            return []
        if gap < 0.0:
            self.intake.forget_stamps()
        away = self._retraction.jump(before, sample, tolerance)
        why = self._retraction.obstacle if away else f"the clock of joint_states went {gap:.4g} s"
        if not self._steering:
            return [Log("warning", why)]
        return self._leave(SteeringState.IDLE, why, "warning")

    def _end_by_retraction(self, sample: JointSample) -> list[Action]:
        if self.control.started:
            self.control.restart()
        self.intake.last = None
        why = f"needle retracted to {sample.insertion:.4g} m: draw it out before steering again"
        return self._leave(SteeringState.IDLE, why, "warning") if self._steering else []

    def _leave(self, state: SteeringState, reason: str, severity: str) -> list[Action]:
        self.state, self.reason = state, reason
        self.awaiting = Awaiting.NOTHING
        self.patience.silence = ""
        self.intake.forget_waiting()
        self._ready_step = self._sent = self._followed = None
        return [Log(severity, f"{state.value}: {reason}" if reason else state.value)]
