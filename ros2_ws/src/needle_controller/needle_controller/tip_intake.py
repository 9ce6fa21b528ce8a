"""From tips as they come to the one a step is made from: with its joints and its covariance.

A tip waits here until joint_states bracket its exposure and, where that is wanted, its covariance
has come. So what is used depends on stamps, never on which topic happened to arrive first.
"""

from __future__ import annotations

from collections import Counter

from needle_controller.joint_history import JointHistory, JointSample
from needle_controller.steering_types import SteeringSettings
from needle_controller.tip_covariance import CovarianceHistory
from needle_controller.tip_gate import (
    AcceptedTip,
    Fault,
    Refusal,
    TipMeasurement,
    refuse_message,
    refuse_position,
    refuse_stamp,
)


class TipIntake:
    """Joins each tip with its joints and covariance, or says why it cannot be used.

    Attributes
    ----------
    joints : JointHistory
        What the joints measured.
    covariances : CovarianceHistory
        What came with the tips.
    last : AcceptedTip or None
        The last tip that was used.
    newest_ns : int or None
        The latest stamp of all tips that could be read [ns].
    refused : Counter
        Tips refused, by `Fault`.
    """

    def __init__(self) -> None:
        self.joints = JointHistory()
        self.covariances = CovarianceHistory()
        self.last: AcceptedTip | None = None
        self.newest_ns: int | None = None
        self.refused: Counter[Fault] = Counter()
        self._pending: TipMeasurement | None = None
        self._pending_since: float | None = None

    def offer(
        self, tip: TipMeasurement, after_ns: int | None, settings: SteeringSettings
    ) -> Refusal | None:
        """Take a tip as it came; it waits if it is the first that is wanted.

        Parameters
        ----------
        tip : TipMeasurement
            The tip.
        after_ns : int or None
            A tip exposed after this is wanted [ns]; None if none is.
        settings : SteeringSettings
            How far out a tip may be.

        Returns
        -------
        Refusal or None
            Why it can never be used, whether wanted or not.
        """
        refusal = refuse_message(tip, self.last)
        if refusal is not None:
            return self._count(refusal)
        self.newest_ns = (
            tip.stamp_ns if self.newest_ns is None else max(self.newest_ns, tip.stamp_ns)
        )
        if after_ns is not None and tip.stamp_ns > after_ns and self._pending is None:
            self._pending, self._pending_since = tip, None
            return None
        # Nobody waits for this one, but a source that is far out is told of at once.
        joints = self.joints.at(tip.stamp_ns) or self.joints.latest
        if joints is None:
            return None
        refusal = refuse_position(tip, joints, None, settings.tip_margin)
        return None if refusal is None else self._count(refusal)

    def take(self, settings: SteeringSettings) -> AcceptedTip | Refusal | None:
        """Return the waiting tip once all that belongs to it has come; None until then."""
        tip = self._pending
        if tip is None:
            return None
        joints = self.joints.at(tip.stamp_ns)
        if joints is None:
            refusal = refuse_stamp(tip, self.joints.oldest, self.joints.latest)
            return None if refusal is None else self._give_up(refusal)
        refusal = refuse_position(tip, joints, self.last, settings.tip_margin)
        accepted: AcceptedTip | None = AcceptedTip(tip, joints)
        if refusal is None and settings.tip_covariance == "from_tip_pose":
            accepted, refusal = self._with_covariance(tip, joints)
        if refusal is not None:
            return self._give_up(refusal)
        if accepted is not None:
            self._pending, self.last = None, accepted
        return accepted

    def forget_pending(self) -> None:
        """Let the waiting tip go."""
        self._pending = None

    def watch(self, steady: float, timeout: float) -> Refusal | None:
        """Refuse a tip that has waited too long, so that the next one gets its chance.

        Parameters
        ----------
        steady : float
            Now, on the steady clock [s].
        timeout : float
            Longest that a tip waits [s].
        """
        tip = self._pending
        if tip is None:
            return None
        if self._pending_since is None:
            self._pending_since = steady
        if steady - self._pending_since < timeout:
            return None
        if self.joints.at(tip.stamp_ns) is None:
            text = "no joint_states around the tip's stamp"
            return self._give_up(Refusal(tip, Fault.NO_JOINTS, text))
        return self._give_up(_without_covariance(tip))

    def _with_covariance(
        self, tip: TipMeasurement, joints: JointSample
    ) -> tuple[AcceptedTip | None, Refusal | None]:
        covariance = self.covariances.at(tip.stamp_ns)
        if covariance is None:
            passed = self.covariances.has_passed(tip.stamp_ns)
            return None, _without_covariance(tip) if passed else None
        problem = covariance.problem()
        if problem:
            return None, Refusal(tip, Fault.BAD_COVARIANCE, problem)
        return AcceptedTip(tip, joints, covariance), None

    def _give_up(self, refusal: Refusal) -> Refusal:
        self._pending = None
        return self._count(refusal)

    def _count(self, refusal: Refusal) -> Refusal:
        self.refused[refusal.fault] += 1
        return refusal


def _without_covariance(tip: TipMeasurement) -> Refusal:
    text = (
        "no needle/tip_pose with the tip's stamp (tip_covariance is from_tip_pose; for a source of "
        "needle/tip alone set it to configured)"
    )
    return Refusal(tip, Fault.NO_COVARIANCE, text)
