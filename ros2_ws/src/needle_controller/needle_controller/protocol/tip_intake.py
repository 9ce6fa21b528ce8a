"""From tips as they come to the one a step is made from: with its joints and its covariance.

Tips wait here, in the order of their stamps, until joint_states bracket their exposure and, where
that is wanted, their covariance has come. So what is used depends on stamps, never on which topic
happened to arrive first.
"""

from __future__ import annotations

from collections import Counter, deque

from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointHistory, JointSample
from needle_controller.protocol.step_watch import REST_INSERTION
from needle_controller.protocol.tip_gate import (
    AcceptedTip,
    Fault,
    RefusedTip,
    TipCovariance,
    TipMeasurement,
    refuse_message,
    refuse_position,
    refuse_stamp,
)

SETTLED_BY = 4
"""Tips in a row that are a jump from the last used one but not from each other: the last counts."""
_MOST_WAITING = 64
_MOVED_ON_SHARE, _MOVED_ON_ROTATION = 0.1, 2e-2
"""Motion since a tip's exposure that makes it a tip of before a motion [steps], [rad]."""
_JOINTS_LATE_NS = 100_000_000
"""Age of the newest joints up to which the stamp of a refused tip is believed [ns]."""


class TipIntake:
    """Joins each tip with its joints and covariance, or says why it cannot be used.

    Attributes
    ----------
    joints : JointHistory
        What the joints measured.
    covariances : deque of TipCovariance
        What came with the last tips.
    last : AcceptedTip or None
        The last tip that was used.
    after_ns : int
        A tip exposed after this is wanted [ns].
    refused : Counter
        Tips refused, by `Fault`.
    """

    def __init__(self) -> None:
        self.joints = JointHistory()
        self.covariances: deque[TipCovariance] = deque(maxlen=_MOST_WAITING)
        self.last: AcceptedTip | None = None
        self.refused: Counter[Fault] = Counter()
        self.after_ns = 0
        self._refused_ns = 0
        self._waiting: list[TipMeasurement] = []
        self._head: TipMeasurement | None = None
        self._head_since = 0.0
        self._jumped: list[AcceptedTip] = []

    def offer(
        self, tip: TipMeasurement, settings: SteeringSettings, *, steering: bool, wanted: bool
    ) -> RefusedTip | None:
        """Take a tip as it came; while the needle is steered it waits for what belongs to it.

        Parameters
        ----------
        tip : TipMeasurement
            The tip.
        settings : SteeringSettings
            How far out a tip may be.
        steering : bool
            Whether it may be used.
        wanted : bool
            Whether one is wanted now.

        Returns
        -------
        RefusedTip or None
            Why it can never be used, whether wanted or not.
        """
        latest = self.joints.latest
        refusal = refuse_message(tip, self.last) or refuse_stamp(tip, None, latest)
        joints = None if wanted else self.joints.at(tip.stamp_ns) or latest
        if refusal is None and joints is not None:
            # Nobody waits for this one, but a source that is far out is told of at once.
            refusal = refuse_position(tip, joints, None, settings.tip_margin)
        if refusal is not None:
            return self._count(refusal)
        if steering:
            self._keep(tip)
        return None

    def want_any(self) -> None:
        """Want whatever tip is newer than the last used one."""
        self._refused_ns = 0
        self.after_ns = self.last.tip.stamp_ns if self.last is not None else 0

    def want_after(self, stamp_ns: int) -> None:
        """Want no tip that was exposed before this [ns]."""
        self.after_ns = max(self.after_ns, stamp_ns)

    def take(
        self, settings: SteeringSettings, *, moving: bool = False
    ) -> AcceptedTip | RefusedTip | None:
        """Return the first tip that is wanted, once all that belongs to it has come.

        Parameters
        ----------
        settings : SteeringSettings
            What is wanted of a tip.
        moving : bool
            Whether a tip counts from where the needle has moved on since.

        Returns
        -------
        AcceptedTip, RefusedTip or None
            None until then. A tip that is returned or refused waits no longer.
        """
        taken = self._take(settings)
        if isinstance(taken, AcceptedTip):
            before, self.last = self.last, taken
            if not moving and self.has_moved_on(settings.step_length):
                self.last = before
                return self.take(settings)
            self._jumped.clear()
            self.want_after(taken.tip.stamp_ns)
        if taken is None and not self._waiting:
            # All that came were refused: another exposure is wanted.
            self.want_after(self._refused_ns)
        return taken

    @property
    def has_moved(self) -> bool:
        """Whether the needle moved since the last used tip."""
        latest, last = self.joints.latest, self.last
        return (
            latest is not None
            and last is not None
            and abs(latest.insertion - last.joints.insertion) > REST_INSERTION
        )

    def has_moved_on(self, step_length: float) -> bool:
        """Return whether the needle moved since the last used tip; if so, a later one is wanted.

        Parameters
        ----------
        step_length : float
            Of one step [m].
        """
        latest = self.joints.latest
        if latest is None or self.last is None:
            return False
        longest = _MOVED_ON_SHARE * step_length
        if latest.is_at(self.last.joints, longest, _MOVED_ON_ROTATION):
            return False
        self.want_after(latest.stamp_ns)
        return True

    def _take(self, settings: SteeringSettings) -> AcceptedTip | RefusedTip | None:
        while self._waiting and self._waiting[0].stamp_ns <= self.after_ns:
            del self._waiting[0]
        if not self._waiting:
            return None
        tip = self._waiting[0]
        joints = self.joints.at(tip.stamp_ns)
        if joints is None:
            refusal = refuse_stamp(tip, self.joints.oldest, self.joints.latest)
            return None if refusal is None else self._give_up(refusal)
        accepted: AcceptedTip | None = AcceptedTip(tip, joints)
        refusal = None
        if settings.tip_covariance == "from_tip_pose":
            accepted, refusal = self._with_covariance(tip, joints)
        if refusal is None and accepted is not None:
            refusal = self._out_of_place(accepted, settings.tip_margin)
        if refusal is not None:
            return self._give_up(refusal)
        if accepted is not None:
            del self._waiting[0]
        return accepted

    def forget_waiting(self) -> None:
        """Let the waiting tips go."""
        self._waiting.clear()
        self._jumped.clear()

    def forget_stamps(self) -> None:
        """Let go of all that is known by its stamp: time begins anew."""
        self.forget_waiting()
        self.covariances.clear()
        self.last = None
        self.want_any()

    def watch(self, steady: float, timeout: float) -> RefusedTip | None:
        """Refuse a tip that has waited too long, so that the next one gets its chance.

        Parameters
        ----------
        steady : float
            Now, on the steady clock [s].
        timeout : float
            Longest that a tip waits [s].
        """
        tip = next((tip for tip in self._waiting if tip.stamp_ns > self.after_ns), None)
        if tip is None or tip is not self._head:
            self._head, self._head_since = tip, steady
        if tip is None or steady - self._head_since < timeout:
            return None
        if self.joints.at(tip.stamp_ns) is None:
            text = "no joint_states around the tip's stamp"
            return self._give_up(RefusedTip(tip, Fault.NO_JOINTS, text))
        return self._give_up(_without_covariance(tip))

    def _keep(self, tip: TipMeasurement) -> None:
        waiting = self._waiting
        # A topic keeps its order: what came before with a later stamp had a wrong one.
        while waiting and waiting[-1].stamp_ns > tip.stamp_ns:
            text = "a tip exposed before it came after it"
            self._count(RefusedTip(waiting.pop(), Fault.AHEAD_OF_JOINTS, text))
        if not waiting or waiting[-1].stamp_ns < tip.stamp_ns:
            waiting.append(tip)
        del waiting[:-_MOST_WAITING]

    def _out_of_place(self, accepted: AcceptedTip, margin: float) -> RefusedTip | None:
        tip, joints = accepted.tip, accepted.joints
        refusal = refuse_position(tip, joints, self.last, margin)
        if refusal is None or refusal.fault is not Fault.JUMP:
            return refusal
        if self._jumped and refuse_position(tip, joints, self._jumped[-1], margin) is not None:
            self._jumped.clear()
        self._jumped.append(accepted)
        return refusal if len(self._jumped) < SETTLED_BY else None

    def _with_covariance(
        self, tip: TipMeasurement, joints: JointSample
    ) -> tuple[AcceptedTip | None, RefusedTip | None]:
        came = reversed(self.covariances)
        covariance = next((c for c in came if c.stamp_ns == tip.stamp_ns), None)
        if covariance is None:
            # A topic keeps its order: after a later stamp's, that of this one never comes.
            passed = bool(self.covariances) and self.covariances[-1].stamp_ns > tip.stamp_ns
            return None, _without_covariance(tip) if passed else None
        problem = covariance.problem()
        if problem:
            return None, RefusedTip(tip, Fault.BAD_COVARIANCE, problem)
        return AcceptedTip(tip, joints, covariance), None

    def _give_up(self, refusal: RefusedTip) -> RefusedTip:
        self._waiting.remove(refusal.tip)
        return self._count(refusal)

    def _count(self, refusal: RefusedTip) -> RefusedTip:
        self.refused[refusal.fault] += 1
        latest, stamp_ns = self.joints.latest, refusal.tip.stamp_ns
        if latest is not None and stamp_ns <= latest.stamp_ns + _JOINTS_LATE_NS:
            self._refused_ns = max(self._refused_ns, stamp_ns)
        return refusal


def _without_covariance(tip: TipMeasurement) -> RefusedTip:
    text = (
        "no needle/tip_pose with the tip's stamp (tip_covariance is from_tip_pose; for a source of "
        "needle/tip alone set it to configured)"
    )
    return RefusedTip(tip, Fault.NO_COVARIANCE, text)
