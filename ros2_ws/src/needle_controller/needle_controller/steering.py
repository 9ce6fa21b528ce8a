"""The step protocol: when the needle is moved, by what data, and when not.

States: IDLE -> STEERING <-> WAITING_FOR_TIP -> DONE | FAULT. Events come in, actions go out; time
is only ever an argument. What is sent depends on stamps, never on the order in which topics
happened to arrive.
"""

from __future__ import annotations

import dataclasses
import enum

from needle_controller.joint_history import JointHistory, JointSample
from needle_controller.plane_control import LARGEST_START_ROLL, ControlUpdate, PlaneControl
from needle_controller.reachability import Reachability, reachability
from needle_controller.tip_gate import (
    AcceptedTip,
    TipMeasurement,
    refuse_message,
    refuse_position,
)

PLANE_TOLERANCE = 1e-3
"""Distance from the plane at which the needle counts as in it, [KC09] IV-A [m]."""
DEPTH_TOLERANCE = 1e-6
"""Insertion short of the depth that counts as there [m]."""
REST_INSERTION = 2e-6
REST_ROTATION = 1e-4
"""What a joint at rest may change by [m], [rad]."""
STAMP_AHEAD_NS = 1_000_000_000
"""A tip's stamp farther ahead of the joints' than this is no time to wait for [ns]."""
MOST_REFUSALS = 10
"""Commands in a row that may end without motion before the controller gives up."""
_STOPPED_DEVICE = ("FAULT", "ESTOPPED")
_DISABLED_DEVICE = ("UNCONFIGURED", "DISABLED")


class State(enum.Enum):
    """The controller's states."""

    IDLE = "IDLE"
    STEERING = "STEERING"
    WAITING_FOR_TIP = "WAITING_FOR_TIP"
    DONE = "DONE"
    FAULT = "FAULT"


class Awaiting(enum.Enum):
    """What the next action needs."""

    NOTHING = "nothing"
    HOLD = "hold"
    TIP = "tip"
    DEVICE = "device"
    RESULT = "result"


@dataclasses.dataclass(frozen=True)
class SteeringSettings:
    """The protocol's numbers.

    Attributes
    ----------
    step_length : float
        Insertion of one step [m].
    nominal_speed : float
        Insertion speed at speed scale 1 [m/s].
    depth : float
        Insertion at which steering ends [m].
    tip_timeout : float
        Time without a good tip after which the state is WAITING_FOR_TIP [s], steady clock.
    tip_margin : float
        What noise may add to a tip's place [m].
    needle_out_insertion : float
        Insertion below which the needle counts as out [m].
    retraction_tolerance : float
        Backward motion that counts as a retraction [m].
    """

    step_length: float
    nominal_speed: float
    depth: float
    tip_timeout: float
    tip_margin: float
    needle_out_insertion: float
    retraction_tolerance: float


@dataclasses.dataclass(frozen=True)
class DeviceStatus:
    """What the driver says of itself."""

    state: str
    homed: bool
    hold_owner: str
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class SendStep:
    """Send one trajectory point.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the tip that caused it [ns].
    insertion, rotation : float
        Wanted joints, absolute [m], [rad].
    duration : float
        Time from start [s].
    """

    stamp_ns: int
    insertion: float
    rotation: float
    duration: float


@dataclasses.dataclass(frozen=True)
class PublishUpdate:
    """Publish estimate and control input, stamped with the tip's exposure."""

    stamp_ns: int
    update: ControlUpdate


@dataclasses.dataclass(frozen=True)
class Log:
    """Say something; `severity` is info, warning or error, `kind` throttles repetitions."""

    severity: str
    text: str
    kind: str = ""


Action = SendStep | PublishUpdate | Log


@dataclasses.dataclass(frozen=True)
class Reply:
    """Answer to a service call."""

    success: bool
    message: str


class Steering:
    """The step protocol of one needle.

    Parameters
    ----------
    settings : SteeringSettings
        The protocol's numbers; may be replaced while it runs.
    control : PlaneControl
        Estimator and law.
    """

    def __init__(self, settings: SteeringSettings, control: PlaneControl) -> None:
        self.settings = settings
        self.control = control
        self.state = State.IDLE
        self.awaiting = Awaiting.NOTHING
        self.reason = "not started"
        self.step = 0
        self.tip_after_ns = 0
        self.tips_rejected = 0
        self.watchdog_trips = 0
        self.insertion = 0.0
        self.rejection = ""
        self.reach: Reachability | None = None
        self.joints = JointHistory()
        self._device: DeviceStatus | None = None
        self._retracted = False
        self._deepest = 0.0
        self._last: AcceptedTip | None = None
        self._newest_tip_ns: int | None = None
        self._pending: TipMeasurement | None = None
        self._ready_step: SendStep | None = None
        self._sent: SendStep | None = None
        self._refusals = 0
        self._awaited_since: float | None = None

    # What a person asks for

    def on_start(self) -> tuple[Reply, list[Action]]:
        """Begin steering, or say why not."""
        obstacle = self._obstacle()
        if obstacle is not None:
            return Reply(False, obstacle), [Log("warning", f"not started: {obstacle}")]
        joints = self.joints.latest
        if joints is not None and self._is_out(joints):
            self.control.restart()
            self._last = None
            self.step = 0
            self._deepest = joints.insertion
        self.state, self.reason, self._refusals = State.STEERING, "", 0
        return Reply(True, "steering"), [Log("info", "steering"), *self._ask()]

    def on_stop(self) -> tuple[Reply, list[Action]]:
        """Send no further step; one under way ends with the hold, or by itself."""
        if not self._steering:
            return Reply(True, f"was not steering ({self.state.value})"), []
        return Reply(True, "stopped"), self._leave(State.IDLE, "stopped", "info")

    # What comes in

    def on_joints(self, sample: JointSample) -> list[Action]:
        """Take a sample of the joints."""
        if not self.joints.add(sample):
            return []
        actions = self._watch_retraction(sample)
        return actions + self._use_pending()

    def on_tip(self, tip: TipMeasurement) -> list[Action]:
        """Take a measured tip: used, kept until the joints bracket it, skipped or refused."""
        why = refuse_message(tip, self._last)
        if why is not None:
            return self._refuse(tip, why)
        newest = self._newest_tip_ns
        self._newest_tip_ns = tip.stamp_ns if newest is None else max(newest, tip.stamp_ns)
        wanted = self._steering and self.awaiting is Awaiting.TIP and self._pending is None
        if not wanted or tip.stamp_ns <= self.tip_after_ns:
            return []
        self._pending = tip
        return self._use_pending()

    def on_result(self, stamp_ns: int, text: str) -> list[Action]:
        """Take the driver's answer to a command; answers to other commands are not ours."""
        if self._sent is None or stamp_ns != self._sent.stamp_ns:
            return []
        self._sent = None
        if not self._steering:
            return []
        if text == "succeeded":
            self.step += 1
            self._refusals = 0
            return self._ask()
        actions: list[Action] = [Log("warning", f"step {self.step + 1} {text}", "abort")]
        self.reason = f"step {text}"
        self._refusals = 0 if self._moved_since_command() else self._refusals + 1
        if self._refusals >= MOST_REFUSALS:
            why = f"{self._refusals} commands in a row ended without motion, the last {text}"
            return actions + self._leave(State.FAULT, why, "error")
        return actions + self._ask()

    def on_device(self, status: DeviceStatus) -> list[Action]:
        """Take the driver's state."""
        self._device = status
        if not self._steering:
            return []
        if status.state in _STOPPED_DEVICE:
            why = f"device is {status.state}: {status.reason}"
            return self._leave(State.FAULT, why, "error")
        if status.state in _DISABLED_DEVICE:
            return self._leave(State.IDLE, f"device is {status.state}", "warning")
        if self.awaiting is Awaiting.HOLD and status.hold_owner:
            return self._ask()
        if self.awaiting is Awaiting.DEVICE:
            return self._send()
        return []

    def on_time(self, steady: float) -> list[Action]:
        """Watch the age of what is awaited.

        Parameters
        ----------
        steady : float
            Now, on the steady clock [s].
        """
        if not (self._steering and self.awaiting is Awaiting.TIP):
            self._awaited_since = None
            return []
        if self._awaited_since is None:
            self._awaited_since = steady
        waited = steady - self._awaited_since
        if waited < self.settings.tip_timeout or self.state is State.WAITING_FOR_TIP:
            return []
        self.state = State.WAITING_FOR_TIP
        self.watchdog_trips += 1
        self.reason = f"no good tip for {self.settings.tip_timeout:g} s"
        if self.rejection:
            self.reason += f"; the last one was refused: {self.rejection}"
        actions: list[Action] = []
        if self._pending is not None:
            # Joints that never came: the next tip gets its chance.
            tip, self._pending = self._pending, None
            actions = self._refuse(tip, "no joint_states around the tip's stamp")
        return [*actions, Log("warning", f"WAITING_FOR_TIP: {self.reason}")]

    # What follows

    @property
    def _steering(self) -> bool:
        return self.state in (State.STEERING, State.WAITING_FOR_TIP)

    def _is_out(self, joints: JointSample) -> bool:
        return joints.insertion <= self.settings.needle_out_insertion

    def _obstacle(self) -> str | None:
        """Return why steering cannot begin, None if it can."""
        device, joints = self._device, self.joints.latest
        obstacles = (
            (self._steering, "already steering"),
            (device is None, "no device/status has come"),
            (joints is None, "no joint_states have come"),
            (device is not None and not device.homed, "the device is not homed"),
            (
                device is not None and device.state not in ("HOLDING", "MOVING"),
                f"the device is not enabled ({device.state if device else ''})",
            ),
            (self._retracted, "the needle was retracted: draw it out first"),
        )
        for stands, text in obstacles:
            if stands:
                return text
        return None if joints is None else self._needle_obstacle(joints)

    def _needle_obstacle(self, joints: JointSample) -> str | None:
        settings = self.settings
        if joints.insertion >= settings.depth - DEPTH_TOLERANCE:
            return f"insertion {joints.insertion:g} m is at the depth {settings.depth:g} m"
        if not self._is_out(joints):
            if self.control.started:
                return None
            return (
                f"the needle is {joints.insertion:g} m in and was not followed there: "
                f"draw it out first (<= {settings.needle_out_insertion:g} m)"
            )
        roll = self.control.start_roll(joints.rotation)
        if abs(roll) > LARGEST_START_ROLL:
            return (
                f"the needle's roll in target_plane is {roll:.3g} rad (rotation_joint "
                f"{joints.rotation:.4g} rad), wants within {LARGEST_START_ROLL:.3g} rad"
            )
        return None

    def _ask(self) -> list[Action]:
        """Ask for a tip of the needle at rest, or for the hold that must come first."""
        self._pending = self._ready_step = None
        if self._device is None or not self._device.hold_owner:
            self.awaiting = Awaiting.HOLD
            return []
        rest = self.joints.motion_end_ns(REST_INSERTION, REST_ROTATION)
        stamps = [self.tip_after_ns, rest or 0, self._last.tip.stamp_ns if self._last else 0]
        idle = self.awaiting in (Awaiting.HOLD, Awaiting.NOTHING)
        if idle and self._newest_tip_ns is not None:
            # The needle stood and nobody held it: the driver wants a younger tip than those.
            stamps.append(self._newest_tip_ns)
        self.tip_after_ns = max(stamps)
        self.awaiting = Awaiting.TIP
        self._awaited_since = None
        return []

    def _refuse(self, tip: TipMeasurement, why: str) -> list[Action]:
        self.tips_rejected += 1
        self.rejection = why
        if self._steering:
            self.reason = f"tip refused: {why}"
        latest = self.joints.latest
        horizon = latest.stamp_ns + STAMP_AHEAD_NS if latest is not None else 0
        if self._steering and self.awaiting is Awaiting.TIP and tip.stamp_ns <= horizon:
            self.tip_after_ns = max(self.tip_after_ns, tip.stamp_ns)
        return [Log("warning", f"tip refused: {why}", "tip")]

    def _use_pending(self) -> list[Action]:
        tip = self._pending
        if tip is None:
            return []
        joints, oldest, latest = (
            self.joints.at(tip.stamp_ns),
            self.joints.oldest,
            self.joints.latest,
        )
        if joints is None:
            why = None
            if oldest is not None and tip.stamp_ns < oldest.stamp_ns:
                why = "tip is older than any joint_states kept"
            elif latest is not None and tip.stamp_ns > latest.stamp_ns + STAMP_AHEAD_NS:
                ahead = (tip.stamp_ns - latest.stamp_ns) * 1e-9
                why = f"tip's stamp is {ahead:.4g} s ahead of joint_states"
        else:
            why = refuse_position(tip, joints, self._last, self.settings.tip_margin)
        if why is not None:
            self._pending = None
            return self._refuse(tip, why)
        if joints is None:
            return []
        self._pending = None
        return self._take(AcceptedTip(tip, joints))

    def _take(self, accepted: AcceptedTip) -> list[Action]:
        tip, joints, settings = accepted.tip, accepted.joints, self.settings
        self._last = accepted
        self.rejection = ""
        self.insertion = joints.insertion
        update = self.control.update(tip.position, joints)
        self.reach = reachability(
            update.estimate.reduced,
            update.estimate.curvature,
            insertion=joints.insertion,
            end=settings.depth,
            tolerance=PLANE_TOLERANCE,
        )
        self.reason = "; ".join(update.estimate.warnings)
        actions: list[Action] = [PublishUpdate(tip.stamp_ns, update)]
        if self.state is State.WAITING_FOR_TIP:
            self.state = State.STEERING
            actions.append(Log("info", "STEERING: a good tip came"))
        remaining = settings.depth - joints.insertion
        if remaining <= DEPTH_TOLERANCE:
            text = f"insertion {joints.insertion:.6g} m reached"
            return actions + self._leave(State.DONE, text, "info")
        length = settings.step_length
        if remaining < length * (1.0 + 1e-3):
            length = remaining
        self._ready_step = SendStep(
            stamp_ns=tip.stamp_ns,
            # Not joints + length: the last step ends at the depth to the last bit.
            insertion=settings.depth if length == remaining else joints.insertion + length,
            rotation=joints.rotation + float(update.command.rotation_rate) * length,
            duration=length / settings.nominal_speed,
        )
        return actions + self._send()

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
        self._ready_step, self._sent = None, step
        self.awaiting = Awaiting.RESULT
        return [step]

    def _moved_since_command(self) -> bool:
        latest = self.joints.latest
        return (
            latest is not None
            and self._last is not None
            and abs(latest.insertion - self._last.joints.insertion) > REST_INSERTION
        )

    def _watch_retraction(self, sample: JointSample) -> list[Action]:
        if self._is_out(sample):
            self._retracted = False
            retracted = self._deepest - sample.insertion > self.settings.retraction_tolerance
            self._deepest = sample.insertion if retracted else max(self._deepest, sample.insertion)
        else:
            self._deepest = max(self._deepest, sample.insertion)
            retracted = self._deepest - sample.insertion > self.settings.retraction_tolerance
            self._retracted = self._retracted or retracted
        if not retracted:
            return []
        self.control.restart()
        self._last = None
        if not self._steering:
            return []
        why = f"needle retracted to {sample.insertion:.4g} m: draw it out before steering again"
        return self._leave(State.IDLE, why, "warning")

    def _leave(self, state: State, reason: str, severity: str) -> list[Action]:
        self.state, self.reason = state, reason
        self.awaiting = Awaiting.NOTHING
        self._pending = self._ready_step = self._sent = None
        return [Log(severity, f"{state.value}: {reason}" if reason else state.value)]
