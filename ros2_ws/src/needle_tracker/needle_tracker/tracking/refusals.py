"""States of the track, and reasons why a pair gives no tip; their texts are counted and shown."""

from __future__ import annotations

import enum


class TrackState(enum.Enum):
    """The tracker's knowledge of the needle."""

    SEARCHING = "SEARCHING"  # nothing is known: the whole reachable region is searched
    CONFIRMING = "CONFIRMING"  # something like a needle, not believed yet
    TRACKING = "TRACKING"
    LOST = "LOST"  # was tracked and is not seen; found again only where it can have got to
    ENTRY = "ENTRY"  # too short to be seen: the tip follows from the insertion


class NoTip(str, enum.Enum):
    """A reason, as a person reads it."""

    def __str__(self) -> str:
        """Return the text."""
        return self.value

    NO_COMMON_POINT = "views do not meet"
    DISAGREE_ALONG = "views disagree along the needle"
    DISAGREE_ACROSS = "views disagree across the needle"
    UNCERTAIN = "too uncertain"
    OUTSIDE = "outside the phantom"
    NEAR_ENTRY = "too close to the entry"
    BEYOND_REACH = "beyond the longest insertion"
    OUTSIDE_CONE = "outside the reachable cone"
    DIRECTION = "direction not reachable"
    BEYOND_INSERTION = "farther than the insertion"
    SHORT_OF_INSERTION = "short of the insertion"
    TOO_FAR = "too far from the last tip"
    SURPRISING = "too far from the prediction"
    UNCLEAR = "not clear enough to begin with"
    UNCONFIRMED = "not confirmed yet"
    STANDS = "not moved yet"
    HIDDEN = "the end is hidden in both images"


def progress(reason: str) -> int:
    """Return how far a detector got with a pair before it gave this reason: more is farther."""
    order = ["no needle", "no clear tip", *NoTip]
    ranks = [rank for rank, known in enumerate(order) if reason.startswith(known)]
    # All that is not listed is said of a shaft whose end has passed the gates.
    return ranks[0] if ranks else order.index(NoTip.TOO_FAR)
