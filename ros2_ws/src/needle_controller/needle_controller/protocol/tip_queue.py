"""Queue of measured tips, each joined with the joint positions and covariance of its stamp.

Tips wait in the order of their stamps until joint_states bracket their exposure and, if it is
required, their covariance has arrived. So the choice of a tip depends on stamps, never on the
order in which topics arrive.
"""

from __future__ import annotations

from collections import Counter, deque

from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointHistory, JointSample
from needle_controller.protocol.tip_checks import (
    AcceptedTip,
    RejectedTip,
    TipCovariance,
    TipFault,
    check_message,
    check_position,
    check_stamp,
)
from needle_core.messages import Point

SETTLED_BY = 4
"""Consecutive tips, near one another but far from the last used tip, that supersede it."""
_QUEUE_LENGTH = 64
_MOVED_SHARE, _MOVED_ROTATION = 0.1, 2e-2
"""Motion since a tip's exposure above which the tip is outdated [step lengths], [rad]."""
_JOINTS_LATE_NS = 100_000_000
"""Largest lead of a rejected tip's stamp over the joints that counts as plausible [ns]."""


class TipQueue:
    """Joins tips with joints and covariances, and rejects those that cannot be used.

    Attributes
    ----------
    joints : JointHistory
        Measured joint positions.
    covariances : deque of TipCovariance
        Latest covariances.
    last : AcceptedTip or None
        The last tip that was used.
    after_ns : int
        Time after which a tip must have been exposed to be used [ns].
    rejected : Counter
        Number of rejected tips of each `TipFault`.
    """

    def __init__(self) -> None:
        self.joints = JointHistory()
        self.covariances: deque[TipCovariance] = deque(maxlen=_QUEUE_LENGTH)
        self.last: AcceptedTip | None = None
        self.rejected: Counter[TipFault] = Counter()
        self.after_ns = 0
        self._newest_rejected_ns = 0
        self._queue: list[Point] = []
        # First tip of the queue, and the time since when [s].
        self._head: tuple[Point, float] | None = None
        self._jumped: list[AcceptedTip] = []

    def add(
        self, tip: Point, settings: SteeringSettings, *, steering: bool, awaited: bool
    ) -> RejectedTip | None:
        """Check a received tip; queue it while the needle is steered.

        Parameters
        ----------
        tip : Point
            The tip.
        settings : SteeringSettings
            Tolerances.
        steering : bool
            Whether the tip may be used.
        awaited : bool
            Whether the next action needs a tip.

        Returns
        -------
        RejectedTip or None
            Why the tip can never be used.
        """
        latest = self.joints.latest
        rejection = check_message(tip, self.last) or check_stamp(tip, None, latest)
        joints = None if awaited else self.joints.at(tip.stamp_ns) or latest
        if rejection is None and joints is not None:
            # This tip is not needed, but an implausible source is reported at once.
            rejection = check_position(tip, joints, None, settings.tip_margin)
        if rejection is not None:
            return self._count(rejection)
        if steering:
            self._enqueue(tip)
        return None

    def accept_any(self) -> None:
        """Accept any tip that is newer than the last used one."""
        self._newest_rejected_ns = 0
        self.after_ns = self.last.tip.stamp_ns if self.last is not None else 0

    def accept_after(self, stamp_ns: int) -> None:
        """Accept only tips exposed after an instant [ns]."""
        self.after_ns = max(self.after_ns, stamp_ns)

    def next_tip(
        self, settings: SteeringSettings, *, moving: bool = False
    ) -> AcceptedTip | RejectedTip | None:
        """Return the first suitable tip once its joints and covariance have arrived.

        Parameters
        ----------
        settings : SteeringSettings
            Requirements for a tip.
        moving : bool
            Whether to use a tip although the needle has moved since its exposure.

        Returns
        -------
        AcceptedTip, RejectedTip or None
            The tip, which leaves the queue; None if none is ready.
        """
        result = self._check_first(settings)
        if isinstance(result, AcceptedTip):
            before, self.last = self.last, result
            if not moving and self.is_outdated(settings.step_length):
                self.last = before
                return self.next_tip(settings)
            self._jumped.clear()
            self.accept_after(result.tip.stamp_ns)
        if result is None and not self._queue:
            # All received tips were rejected: a new exposure is needed.
            self.accept_after(self._newest_rejected_ns)
        return result

    @property
    def has_moved(self) -> bool:
        """Whether the needle has moved since the last used tip."""
        latest, last = self.joints.latest, self.last
        return not (latest is None or last is None or latest.is_at_rest(last.joints))

    def is_outdated(self, step_length: float) -> bool:
        """Return whether the needle moved too far for the last tip; if so, require a later one."""
        latest = self.joints.latest
        if latest is None or self.last is None:
            return False
        if latest.is_near(self.last.joints, _MOVED_SHARE * step_length, _MOVED_ROTATION):
            return False
        self.accept_after(latest.stamp_ns)
        return True

    def clear(self) -> None:
        """Remove the queued tips."""
        self._queue.clear()
        self._jumped.clear()

    def forget_stamps(self) -> None:
        """Discard everything that has a stamp, after the clock was set back."""
        self.clear()
        self.covariances.clear()
        self.last = None
        self.accept_any()

    def expire(self, steady: float, timeout: float) -> RejectedTip | None:
        """Reject the first tip if it has waited too long, so that the next one can be used.

        Parameters
        ----------
        steady : float
            Time of the steady clock [s].
        timeout : float
            Longest waiting time [s].
        """
        tip = next((tip for tip in self._queue if tip.stamp_ns > self.after_ns), None)
        if tip is None:
            self._head = None
            return None
        if self._head is None or self._head[0] is not tip:
            self._head = tip, steady
        if steady - self._head[1] < timeout:
            return None
        if self.joints.at(tip.stamp_ns) is None:
            text = "no joint_states around the tip's stamp"
            return self._reject(RejectedTip(tip, TipFault.NO_JOINTS, text))
        return self._reject(_missing_covariance(tip))

    def _check_first(self, settings: SteeringSettings) -> AcceptedTip | RejectedTip | None:
        while self._queue and self._queue[0].stamp_ns <= self.after_ns:
            del self._queue[0]
        if not self._queue:
            return None
        tip = self._queue[0]
        joints = self.joints.at(tip.stamp_ns)
        result: AcceptedTip | RejectedTip | None
        if joints is None:
            result = check_stamp(tip, self.joints.oldest, self.joints.latest)
        elif settings.tip_covariance == "from_tip_pose":
            result = self._with_covariance(tip, joints)
        else:
            result = AcceptedTip(tip, joints)
        if isinstance(result, AcceptedTip):
            result = self._check_position(result, settings.tip_margin) or result
        if isinstance(result, RejectedTip):
            return self._reject(result)
        if result is not None:
            del self._queue[0]
        return result

    def _enqueue(self, tip: Point) -> None:
        queue = self._queue
        # A topic keeps its order, so earlier tips with a later stamp had a wrong stamp.
        while queue and queue[-1].stamp_ns > tip.stamp_ns:
            text = "a tip with an earlier exposure arrived after it"
            self._count(RejectedTip(queue.pop(), TipFault.AHEAD_OF_JOINTS, text))
        if not queue or queue[-1].stamp_ns < tip.stamp_ns:
            queue.append(tip)
        del queue[:-_QUEUE_LENGTH]

    def _check_position(self, accepted: AcceptedTip, margin: float) -> RejectedTip | None:
        tip, joints = accepted.tip, accepted.joints
        rejection = check_position(tip, joints, self.last, margin)
        if rejection is None or rejection.fault is not TipFault.JUMP:
            return rejection
        if self._jumped and check_position(tip, joints, self._jumped[-1], margin) is not None:
            self._jumped.clear()
        self._jumped.append(accepted)
        return rejection if len(self._jumped) < SETTLED_BY else None

    def _with_covariance(self, tip: Point, joints: JointSample) -> AcceptedTip | RejectedTip | None:
        newest_first = reversed(self.covariances)
        covariance = next((c for c in newest_first if c.stamp_ns == tip.stamp_ns), None)
        if covariance is None:
            # A topic keeps its order: after a later stamp, this one will not arrive.
            passed = bool(self.covariances) and self.covariances[-1].stamp_ns > tip.stamp_ns
            return _missing_covariance(tip) if passed else None
        problem = covariance.problem()
        if problem:
            return RejectedTip(tip, TipFault.BAD_COVARIANCE, problem)
        return AcceptedTip(tip, joints, covariance)

    def _reject(self, rejection: RejectedTip) -> RejectedTip:
        self._queue.remove(rejection.tip)
        return self._count(rejection)

    def _count(self, rejection: RejectedTip) -> RejectedTip:
        self.rejected[rejection.fault] += 1
        latest, stamp_ns = self.joints.latest, rejection.tip.stamp_ns
        if latest is not None and stamp_ns <= latest.stamp_ns + _JOINTS_LATE_NS:
            self._newest_rejected_ns = max(self._newest_rejected_ns, stamp_ns)
        return rejection


def _missing_covariance(tip: Point) -> RejectedTip:
    text = (
        "no needle/tip_pose with the tip's stamp (tip_covariance is from_tip_pose; for a source of "
        "needle/tip alone set it to configured)"
    )
    return RejectedTip(tip, TipFault.NO_COVARIANCE, text)
