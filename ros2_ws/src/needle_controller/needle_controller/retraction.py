"""Whether the needle was drawn back: the model holds for forward insertion only."""

from __future__ import annotations


class RetractionWatch:
    """Follows the insertion, and remembers a retraction until the needle is out.

    Attributes
    ----------
    retracted : bool
        Whether the needle was drawn back and is not out yet.
    """

    def __init__(self) -> None:
        self.retracted = False
        self._deepest = 0.0

    def begin(self, insertion: float) -> None:
        """Start over at an insertion [m]."""
        self._deepest = insertion

    def watch(self, insertion: float, *, is_out: bool, tolerance: float) -> bool:
        """Take where the needle is; return whether it is being drawn back.

        Parameters
        ----------
        insertion : float
            Of the needle [m].
        is_out : bool
            Whether that counts as out.
        tolerance : float
            Backward motion that is none yet [m].
        """
        deepest = max(self._deepest, insertion)
        drawn_back = deepest - insertion > tolerance
        self.retracted = not is_out and (self.retracted or drawn_back)
        self._deepest = insertion if is_out and drawn_back else deepest
        return drawn_back
