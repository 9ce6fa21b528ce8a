"""The step protocol: when the needle moves, and based on which data.

States: IDLE -> STEERING <-> WAITING_FOR_TIP -> DONE | FAULT. Handlers take events and return
actions; time is an argument. Commands depend on stamps, never on the order in which topics arrive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from needle_controller.presets.own_parts import OwnPartError
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import (
    Action,
    Awaiting,
    PublishUpdate,
    SendStep,
    StartReply,
    SteeringState,
    next_step,
)
from needle_controller.protocol.confidence import Confidence, assess_confidence
from needle_controller.protocol.joint_history import JointSample, SampleResult
from needle_controller.protocol.motion_monitors import (
    FailureCounter,
    RetractionMonitor,
    StepMonitor,
    StepOutcome,
    Watchdog,
)
from needle_controller.protocol.plane_control import ControlUpdate, PlaneControl, Reachability
from needle_controller.protocol.start_conditions import is_out, reason_not_to_start
from needle_controller.protocol.tip_checks import (
    AcceptedTip,
    RejectedTip,
    TipCovariance,
)
from needle_controller.protocol.tip_queue import TipQueue
from needle_core.component import Log
from needle_core.messages import Point
from needle_core.status_messages import DeviceStatus


class Steering:
    """The step protocol of one needle.

    Parameters
    ----------
    settings : SteeringSettings
        Settings of estimator, law and protocol; `configure` changes them.

    Attributes
    ----------
    control : PlaneControl
        Estimator and law.
    state, awaiting, reason : SteeringState, Awaiting, str
        Present state, the input that the next action needs, and the cause of a problem.
    starts, step, watchdog_trips : int
        Numbers of starts, of completed steps, and of timeouts.
    rejection : str
        Why the last tip was rejected; empty once one was used.
    command_ns : int
        Stamp of the last command sent [ns]; 0 before the first.
    insertion, reach, confidence : float, Reachability or None, Confidence
        At the last used tip: insertion [m], reachability of the target, confidence.
    tips, watchdog : TipQueue, Watchdog
        Queued tips with joint positions; waiting times.
    """

    _moves_while_awaiting_tip = False

    def __init__(self, settings: SteeringSettings) -> None:
        self.settings = settings
        self.control = PlaneControl(settings)
        self.state = SteeringState.IDLE
        self.awaiting = Awaiting.NOTHING
        self.reason = "not started"
        self.starts = self.step = self.watchdog_trips = 0
        self.rejection = ""
        self.command_ns = 0
        self.insertion = 0.0
        self.reach: Reachability | None = None
        self.confidence = Confidence()
        self.tips = TipQueue()
        self.watchdog = Watchdog()
        self._retraction = RetractionMonitor()
        self._device: DeviceStatus | None = None
        self._ready_step: SendStep | None = None
        self._sent: SendStep | None = None
        self._step_monitor: StepMonitor | None = None
        self._failures = FailureCounter()

    def configure(self, settings: SteeringSettings) -> None:
        """Change the settings; a received plane stays unless `target_offset` changes."""
        self.control.configure(settings)
        self.settings = settings

    def on_start(self) -> tuple[StartReply, list[Action]]:
        """Start steering, or reply why it cannot start."""
        joints, why = self.tips.joints.latest, "already steering"
        if not self.is_steering:
            withdrawal = self._retraction.reason
            why = reason_not_to_start(self._device, joints, withdrawal, self.control, self.settings)
        if why:
            return StartReply(False, why), [Log("warning", f"not started: {why}")]
        if joints is not None and is_out(joints, self.settings):
            self.control.restart()
            self.tips.last = None
            self.step = 0
            self._retraction.reset(joints.insertion)
        self.state, self.reason = SteeringState.STEERING, ""
        self.starts += 1
        self._failures.reset()
        self.tips.accept_any()
        return StartReply(True, "steering"), [Log("info", "steering"), *self._await_tip()]

    def on_stop(self) -> tuple[StartReply, list[Action]]:
        """Stop sending steps; one in progress ends with the hold, or at its end."""
        if not self.is_steering:
            return StartReply(True, f"was not steering ({self.state.value})"), []
        return StartReply(True, "stopped"), self._leave(SteeringState.IDLE, "stopped", "info")

    def on_joints(self, sample: JointSample) -> list[Action]:
        """Handle a joint sample."""
        before, problem = self.tips.joints.latest, self.tips.joints.problem
        result = self.tips.joints.add(sample)
        if result is SampleResult.REJECTED and not problem:
            return [Log("warning", self.tips.joints.problem, "joints")]
        if result in {SampleResult.REJECTED, SampleResult.REPEATED}:
            return []
        actions = self.watchdog.on_device_message()
        if result is SampleResult.JUMPED and before is not None:
            actions += self._on_joint_jump(before, sample)
        out_below = self.settings.needle_out_insertion
        tolerance = self.settings.retraction_tolerance
        if self._retraction.update(sample.insertion, out_below=out_below, tolerance=tolerance):
            actions += self._on_retraction(sample)
        return actions + self._check_step(sample) + self._use_tips()

    def on_tip(self, tip: Point) -> list[Action]:
        """Handle a measured tip: use it, queue it until its other data arrive, or reject it."""
        awaited = self.is_steering and self.awaiting is Awaiting.TIP
        rejection = self.tips.add(tip, self.settings, steering=self.is_steering, awaited=awaited)
        return [*(self._on_rejection(rejection) if rejection else ()), *self._use_tips()]

    def on_tip_pose(self, covariance: TipCovariance) -> list[Action]:
        """Handle the covariance of the tip with the same stamp."""
        self.tips.covariances.append(covariance)
        return self._use_tips()

    def on_result(self, stamp_ns: int, text: str, sent_ns: int = 0) -> list[Action]:
        """Handle the driver's answer to a command; ignore answers to other publishers' commands.

        Parameters
        ----------
        stamp_ns : int
            Stamp of the command [ns].
        text : str
            "succeeded", or the reason for the abort.
        sent_ns : int
            Time at which the device sent the answer, on its own clock [ns]; 0 if unknown.
        """
        if self._sent is None or stamp_ns != self._sent.stamp_ns:
            return []
        step, self._sent = self._sent, None
        if not self.is_steering:
            return []
        if text == "succeeded":
            self._step_monitor = StepMonitor(step, sent_ns)
            return [*self._await_tip(), *self._check_step(None), *self._use_tips()]
        return self._on_abort("step", f"step {self.step + 1}", text)

    def on_recorded_step(self, stamp_ns: int, end: JointSample) -> None:
        """Replace a sent step with a recorded one, given its command's stamp [ns] and its end."""
        if self._sent is not None:
            self._sent = SendStep(stamp_ns, end.insertion, end.rotation, self._sent.duration)

    def on_device(self, status: DeviceStatus) -> list[Action]:
        """Handle the driver's status."""
        if not status.hold_owner:
            # A release is not a failure: reset the failure count.
            self._failures.reset()
        self._device = status
        actions = self.watchdog.on_device_message()
        if not self.is_steering:
            return actions
        if status.state in {"FAULT", "ESTOPPED"}:
            why = f"device is {status.state}: {status.why}"
            return actions + self._leave(SteeringState.FAULT, why, "error")
        if status.state in {"UNCONFIGURED", "DISABLED"}:
            return actions + self._leave(SteeringState.IDLE, f"device is {status.state}", "warning")
        if self.awaiting is Awaiting.HOLD and status.hold_owner:
            actions += self._await_tip()
        elif self.awaiting is Awaiting.DEVICE:
            actions += self._send()
        return actions

    def on_time(self, steady: float) -> list[Action]:
        """Check the timeouts at a time of the steady clock [s]."""
        if not (self.is_steering and self.awaiting in {Awaiting.TIP, Awaiting.RESULT}):
            self.watchdog.restart()
            return []
        moving = self.awaiting is Awaiting.RESULT and self._is_moving()
        waited = self.watchdog.waited(steady, moving=moving)
        if self.awaiting is Awaiting.RESULT:
            return self._check_result_timeout(waited, steady)
        return self._check_tip_timeout(waited, steady)

    @property
    def is_steering(self) -> bool:
        """Whether steps follow as soon as a hold counts."""
        return self.state in {SteeringState.STEERING, SteeringState.WAITING_FOR_TIP}

    def _is_moving(self) -> bool:
        """Return whether the device reports motion or the joints have moved since the last call."""
        has_moved = self.watchdog.has_moved(self.tips.joints.latest)
        return has_moved or (self._device is not None and self._device.state == "MOVING")

    def _check_tip_timeout(self, waited: float, steady: float) -> list[Action]:
        actions: list[Action] = []
        if (rejection := self.tips.expire(steady, self.settings.tip_timeout)) is not None:
            self.watchdog_trips += 1
            actions = [*self._on_rejection(rejection), *self._use_tips()]
        if waited < self.settings.tip_timeout or self.state is SteeringState.WAITING_FOR_TIP:
            return actions
        self.state = SteeringState.WAITING_FOR_TIP
        self.watchdog_trips += 1
        self.reason = f"no good tip for {self.settings.tip_timeout:g} s"
        if self._step_monitor is not None:
            self.reason = f"joint_states do not show the end of step {self.step + 1}"
        elif self.rejection:
            self.reason += f"; the last one was refused: {self.rejection}"
        return [*actions, Log("warning", f"WAITING_FOR_TIP: {self.reason}")]

    def _check_result_timeout(self, waited: float, steady: float) -> list[Action]:
        timeout = self.settings.result_timeout
        if waited < timeout:
            return self.watchdog.check_silence(steady, timeout)
        self.watchdog_trips += 1
        why = (
            f"no device/result for step {self.step + 1} in {timeout:g} s, and the device does "
            "not move: the command or its result was lost"
        )
        return self._leave(SteeringState.FAULT, why, "error")

    def _on_abort(self, kind: str, name: str, text: str) -> list[Action]:
        """Continue after an aborted command, unless there were too many in a row."""
        actions: list[Action] = [Log("warning", f"{name} {text}", "abort")]
        self.reason = f"{kind} {text}"
        why = self._failures.count_abort(text, moved=self.tips.has_moved)
        if why:
            return actions + self._leave(SteeringState.FAULT, why, "error")
        return actions + self._await_tip() + self._use_tips()

    def _await_tip(self) -> list[Action]:
        """Await a tip of the needle at rest, or the hold that must come first."""
        self._ready_step = None
        if self._device is None or not self._device.hold_owner:
            self.awaiting = Awaiting.HOLD
            return []
        latest = self.tips.joints.latest
        if self._step_monitor is None and latest is not None:
            # Any motion had ended by the latest sample.
            self.tips.accept_after(latest.stamp_ns)
        self.awaiting = Awaiting.TIP
        self.watchdog.restart()
        return []

    def _check_step(self, sample: JointSample | None) -> list[Action]:
        """Check whether the joints have followed the step that the device reports as done."""
        monitor = self._step_monitor
        if monitor is None:
            return []
        outcome = monitor.update(self.tips.joints, sample)
        if outcome is StepOutcome.PENDING:
            return []
        self._step_monitor = None
        self.tips.accept_after(monitor.end_ns)
        if outcome is StepOutcome.ARRIVED or sample is None:
            self.step += 1
            self._failures.reset()
            return []
        why, give_up = self._failures.count_unfollowed(monitor.step, sample)
        if give_up:
            return self._leave(SteeringState.FAULT, why, "error")
        self.reason = why
        return [Log("warning", why, "unfollowed")]

    def _on_rejection(self, rejection: RejectedTip) -> list[Action]:
        self.rejection = rejection.text
        text = f"tip refused: {rejection.text}"
        if self.is_steering:
            self.reason = text
        return [Log("warning", text, f"tip {rejection.fault.value}")]

    def _use_tips(self) -> list[Action]:
        actions: list[Action] = []
        while self.is_steering and self.awaiting is Awaiting.TIP and self._step_monitor is None:
            tip = self.tips.next_tip(self.settings, moving=self._moves_while_awaiting_tip)
            if tip is None:
                break
            if isinstance(tip, AcceptedTip):
                actions += self._on_accepted_tip(tip)
            else:
                actions += self._on_rejection(tip)
        return actions

    def _on_accepted_tip(self, accepted: AcceptedTip) -> list[Action]:
        update, actions = self._update_control(accepted)
        if update is None:
            return actions
        joints, slowly = accepted.joints, self.confidence.is_doubtful
        self._ready_step = next_step(joints, update.command, self.settings, slowly=slowly)
        if self._ready_step is None:
            return actions + self._finish(update, joints)
        return actions + self._send()

    def _update_control(
        self, accepted: AcceptedTip, intermediate: Sequence[JointSample] = ()
    ) -> tuple[ControlUpdate | None, list[Action]]:
        """Update estimator and law; return None if steering cannot continue."""
        tip, joints = accepted.tip, accepted.joints
        self.rejection = ""
        self.insertion = joints.insertion
        try:
            update = self.control.update(tip.position, joints, accepted.covariance, intermediate)
        except OwnPartError as error:
            return None, self._leave(SteeringState.FAULT, str(error), "error")
        self.reach = update.reach
        self.confidence = assess_confidence(update.estimate)
        self.reason = "; ".join(update.estimate.warnings)
        actions: list[Action] = [PublishUpdate(tip.stamp_ns, update)]
        if self.state is SteeringState.WAITING_FOR_TIP:
            self.state = SteeringState.STEERING
            actions.append(Log("info", "STEERING: received a good tip"))
        if update.blocked:
            why = f"no path from insertion {joints.insertion:.4g} m avoids the obstacles"
            return None, [*actions, *self._leave(SteeringState.IDLE, why, "warning")]
        return update, actions

    def _finish(self, update: ControlUpdate, joints: JointSample) -> list[Action]:
        self.confidence = assess_confidence(update.estimate, update.miss_probability)
        text = f"insertion {joints.insertion:.6g} m reached; {self.confidence.summary}"
        return self._leave(SteeringState.DONE, text, "info")

    def _send(self) -> list[Action]:
        step, device = self._ready_step, self._device
        if step is None or device is None or not device.hold_owner:
            # The step was computed for an earlier hold, and is discarded.
            self._ready_step = None
            self.awaiting = Awaiting.HOLD
            return []
        if device.state != "HOLDING":
            self.awaiting = Awaiting.DEVICE
            return []
        if self.tips.is_outdated(self.settings.step_length):
            self._ready_step = None
            self.awaiting = Awaiting.TIP
            return self._use_tips()
        self._ready_step, self._sent = None, step
        self.command_ns = step.stamp_ns
        self.awaiting = Awaiting.RESULT
        self.watchdog.restart()
        return [step]

    def _on_joint_jump(self, before: JointSample, sample: JointSample) -> list[Action]:
        """Handle joints that have jumped in position or time without an observed motion."""
        settings, gap = self.settings, (sample.stamp_ns - before.stamp_ns) * 1e-9
        tolerance = settings.retraction_tolerance
        if gap > 0.0 and sample.is_near(before, settings.step_length + tolerance, math.inf):
            # Just a gap in the messages.
            return []
        why = "joint_states are back"
        if gap < 0.0:
            self.tips.forget_stamps()
            why = f"the clock of joint_states went {gap:.4g} s"
        if self._retraction.add_jump(before, sample, tolerance):
            why = self._retraction.reason
        if not self.is_steering:
            return [Log("warning", why)]
        return self._leave(SteeringState.IDLE, why, "warning")

    def _on_retraction(self, sample: JointSample) -> list[Action]:
        if self.control.started:
            self.control.restart()
        self.tips.last = None
        why = f"needle retracted to {sample.insertion:.4g} m: withdraw it before steering again"
        return self._leave(SteeringState.IDLE, why, "warning") if self.is_steering else []

    def _leave(self, state: SteeringState, reason: str, severity: str) -> list[Action]:
        self.state, self.reason = state, reason
        self.awaiting = Awaiting.NOTHING
        self.watchdog.silence = ""
        self.tips.clear()
        self._ready_step = self._sent = self._step_monitor = None
        return [Log(severity, f"{state.value}: {reason}" if reason else state.value)]
