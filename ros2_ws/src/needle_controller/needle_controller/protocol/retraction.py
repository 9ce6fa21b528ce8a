"""Whether the needle was drawn back: the model holds for forward insertion only."""

from __future__ import annotations

import statistics
from collections import deque

from needle_controller.protocol.joint_history import JointSample

_LOOKED_AT = 5
"""Samples whose median is where the needle is: no single one, nor two, say that it moved."""
_ENOUGH = 3
_TURNED = 0.1
"""Rotation within which the joints are back where they were before a jump [rad]."""


class RetractionWatch:
    """Follows the insertion, and remembers until the needle is out why it may not go on.

    Joints that jump were not seen to move: steering may go on once they have jumped back to where
    the needle was followed to.
    """

    def __init__(self) -> None:
        self._drawn_back = False
        self._deepest = 0.0
        self._recent: deque[float] = deque(maxlen=_LOOKED_AT)
        self._before: JointSample | None = None
        self._after: JointSample | None = None

    @property
    def obstacle(self) -> str:
        """Reason to draw the needle out before it is steered; empty if there is none."""
        if self._drawn_back:
            return "the needle was retracted: draw it out first"
        if self._before is not None and self._after is not None:
            return (
                f"joint_states jumped from {self._before.insertion:.4g} m, "
                f"{self._before.rotation:.4g} rad to {self._after.insertion:.4g} m, "
                f"{self._after.rotation:.4g} rad: draw the needle out first"
            )
        return ""

    def begin(self, insertion: float) -> None:
        """Start over at an insertion [m]."""
        self._deepest = insertion
        self._drawn_back = False
        self._recent.clear()
        self._before = self._after = None

    def watch(self, insertion: float, *, out_below: float, tolerance: float) -> bool:
        """Take where the needle is; return whether it is being drawn back.

        Parameters
        ----------
        insertion : float
            Of the needle [m].
        out_below : float
            Insertion up to which it counts as out [m].
        tolerance : float
            Backward motion that is none yet [m].
        """
        self._recent.append(insertion)
        if len(self._recent) < _ENOUGH:
            return False
        here = statistics.median_low(self._recent)
        is_out = here <= out_below
        if self._before is not None:
            if is_out:
                self.begin(here)
            return False
        self._deepest = max(self._deepest, here)
        drawn_back = self._deepest - here > tolerance
        self._drawn_back = not is_out and (self._drawn_back or drawn_back)
        if is_out and drawn_back:
            self._deepest = here
        return drawn_back

    def jump(self, before: JointSample, after: JointSample, tolerance: float) -> bool:
        """Take that the joints are elsewhere without having been seen to move there.

        Parameters
        ----------
        before, after : JointSample
            Where they were, and are.
        tolerance : float
            Insertion within which they are back [m].

        Returns
        -------
        bool
            Whether they are away from where the needle was followed to.
        """
        self._recent.clear()
        followed = self._before or before
        away = not after.is_at(followed, tolerance, _TURNED)
        self._before, self._after = (followed, after) if away else (None, None)
        return away
