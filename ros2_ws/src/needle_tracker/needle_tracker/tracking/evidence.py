"""Evidence that is needed before a tip is believed that was found without a prediction.

One good sight in both views is enough where the needle must be; what contradicts the track, or is
seen less well, has to be seen again, and again in agreement with itself.
"""

from __future__ import annotations

import dataclasses
import math

from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.tracking.following import (
    PLAIN_ALONG_PX,
    PLAIN_PX,
    SOUND_ALONG_PX,
    SOUND_PX,
    shows_end,
)
from needle_tracker.tracking.following import is_sound as shows_end_well
from needle_tracker.tracking.refusals import TrackState

Found = tuple[ImageTip | None, ImageTip | None]

# Standard deviations of an end that is seen, across and along [px]: well enough where it must be,
# and to be asked for again.
_NEAR_PX, _NEAR_ALONG_PX = 0.6, 3.0
CLEAR_PX, CLEAR_ALONG_PX = 0.8, 3.0
# The needle stands out in one view by so much more than in the other; and by less where something
# disturbs a line, which may then be the needle's and another one.
_VISIBILITY_RATIO, _DISTURBED_RATIO = 2.2, 1.5
# So many in a row that agree win against the track, or without one that is good.
_SOUND_SIGHTS, _UNSOUND_SIGHTS = 2, 3
_EXCLUDED_SIGHTS = 4  # of what is plain, where a needle cannot have got to by what was known
_MORE_UNLIKE = 1  # where the needle stands out more, or less, than it did
_MORE_TRACKING = 2  # while the needle is followed
_FAINTER, _PLAINER = 0.7, 1.25  # than it did; what lies over it adds to it
_MIXED = 0.85  # fainter than this, a line that is disturbed may be half a shadow's
# Where the needle must be, light on it may take more away; and one whose line [px] nothing disturbs
# may stand out more.
_DIM, _PLAINEST, _UNDISTURBED_PX = 0.4, 1.4, 0.2
_NEW_SHARE = 0.2
_UNLIKE_PX = 2.0  # what is unlike the needle lies so far beside it [px]


def is_sound(found: Found, across_px: float, along_px: float) -> bool:
    """Return whether both views show the same needle's end well.

    Parameters
    ----------
    found : pair of (ImageTip or None)
        What the left and the right image show.
    across_px, along_px : float
        Largest standard deviations of the end [px].
    """
    left, right = found
    if left is None or right is None or not look_alike(left, right):
        return False
    return all(shows_end(tip, across_px, along_px) for tip in (left, right))


def has_come(found: Found, *, since_empty: bool = False) -> bool:
    """Return whether both views show an end where nothing was before: it needs no further sight.

    Parameters
    ----------
    found : pair of (ImageTip or None)
        What the left and the right image show.
    since_empty : bool
        Whether before means in the empty phantom. That may be of another day: tracks that other
        insertions left since are as new as the needle.
    """
    each = all(tip is not None and (tip.all_new if since_empty else tip.come) for tip in found)
    return each and is_sound(found, CLEAR_PX, CLEAR_ALONG_PX)


def shows_lines(found: Found) -> bool:
    """Return whether both views show at least the needle's line."""
    return all(tip is not None and tip.doubt_across <= CLEAR_PX for tip in found)


def is_half_sound(found: Found) -> bool:
    """Return whether one view shows the needle's end well, and the other at least its line."""
    left, right = found
    if left is None or right is None or not look_alike(left, right):
        return False
    lines = max(left.doubt_across, right.doubt_across) <= _NEAR_PX
    return lines and (shows_end_well(left) or shows_end_well(right))


def look_alike(left: ImageTip, right: ImageTip) -> bool:
    """Return whether the lines that both views show can be of one needle."""
    disturbed = max(left.doubt_across, right.doubt_across) > SOUND_PX
    fainter, plainer = sorted((left.visibility, right.visibility))
    return plainer <= (_DISTURBED_RATIO if disturbed else _VISIBILITY_RATIO) * fainter


class VisibilityAverage:
    """Average visibility of the needle in both views while it is seen well."""

    def __init__(self) -> None:
        self._levels: tuple[float, float] | None = None

    def forget(self) -> None:
        """Begin anew."""
        self._levels = None

    def see(self, tips: tuple[ImageTip, ImageTip]) -> None:
        """Take in what a good sight shows."""
        now = (tips[0].visibility, tips[1].visibility)
        before = now if self._levels is None else self._levels
        self._levels = (
            before[0] + _NEW_SHARE * (now[0] - before[0]),
            before[1] + _NEW_SHARE * (now[1] - before[1]),
        )

    def is_like(self, tips: tuple[ImageTip, ImageTip]) -> bool:
        """Return whether both needles stand out about as much; what lies over one does more."""
        return self.is_like_in(0, tips[0]) and self.is_like_in(1, tips[1])

    def is_like_in(self, i: int, tip: ImageTip) -> bool:
        """Return whether the needle stands out about as much in the left (0) or right (1) view."""
        if self._levels is None:
            return True
        return _FAINTER < tip.visibility / self._levels[i] < _PLAINER

    def allows(self, tips: tuple[ImageTip, ImageTip]) -> bool:
        """Return whether these can be the needle, if they lie where it must be."""
        return all(self._allows_in(i, tip) for i, tip in enumerate(tips))

    def _allows_in(self, i: int, tip: ImageTip) -> bool:
        if self._levels is None:
            return True
        plainest = _PLAINEST if tip.doubt_across <= _UNDISTURBED_PX else _PLAINER
        return _DIM < tip.visibility / self._levels[i] < plainest

    def doubted(self, tips: tuple[ImageTip, ImageTip]) -> tuple[ImageTip, ImageTip]:
        """Return the tips, with the line of one that is unlike the needle hardly known."""
        left, right = (
            tip if self.is_like_in(i, tip) and not self._is_mixed_in(i, tip) else _hardly_known(tip)
            for i, tip in enumerate(tips)
        )
        return left, right

    def unmixed(self, tips: tuple[ImageTip, ImageTip]) -> tuple[ImageTip, ImageTip]:
        """Return the tips, with a line hardly known that may not be the needle's alone.

        Something disturbs it, and it is fainter than the needle was, as between needle and shadow,
        or plainer, as where two lines run together.
        """
        left, right = (
            _hardly_known(tip) if self._is_mixed_in(i, tip) else tip for i, tip in enumerate(tips)
        )
        return left, right

    def _is_mixed_in(self, i: int, tip: ImageTip) -> bool:
        if self._levels is None or tip.doubt_across <= SOUND_PX:
            return False
        return not _MIXED < tip.visibility / self._levels[i] < _PLAINER


def _hardly_known(tip: ImageTip) -> ImageTip:
    unlike = tip.allowance * _UNLIKE_PX
    return dataclasses.replace(tip, sigma_across=math.hypot(tip.sigma_across, unlike))


def sights_to_contradict(
    state: TrackState, found: Found, *, alike: bool, on_way: bool, come: bool
) -> int:
    """Return how many sights in a row win against a track that contradicts them; 0 where none do.

    Parameters
    ----------
    state : TrackState
        The track's.
    found : pair of (ImageTip or None)
        What both views show.
    alike : bool
        Whether the needle stands out as it did.
    on_way : bool
        Whether it lies where its tip has been.
    come : bool
        Whether nothing but the last place, without the insertion, speaks against an end that has
        come: a needle goes as far between two pairs as it likes.
    """
    if come and has_come(found):
        return 1
    # While the needle is followed, what looks unlike it is what lies beside or over it.
    unlike = state is TrackState.TRACKING and not alike
    if unlike or not is_sound(found, SOUND_PX, _NEAR_ALONG_PX):
        return 0
    sure = on_way or is_sound(found, PLAIN_PX, PLAIN_ALONG_PX) or state is not TrackState.TRACKING
    return _SOUND_SIGHTS + (0 if alike else _MORE_UNLIKE) + (0 if sure else _MORE_TRACKING)


def sights_to_exclude(state: TrackState, found: Found, *, alike: bool) -> int | None:
    """Return how many sights in a row say that an established track was wrong; None: none do.

    Parameters
    ----------
    state : TrackState
        The track's.
    found : pair of (ImageTip or None)
        What both views show where the needle cannot have got to.
    alike : bool
        Whether the needle stands out as it did.
    """
    plain = alike and is_sound(found, PLAIN_PX, PLAIN_ALONG_PX)
    return _EXCLUDED_SIGHTS if plain and state is TrackState.LOST else None


def sights_to_confirm(
    state: TrackState,
    found: Found,
    *,
    alike: bool,
    possible: bool,
    near: bool,
    guided: bool,
    come: bool,
) -> int | None:
    """Return how many sights in a row are wanted of a tip that nothing contradicts.

    Parameters
    ----------
    state : TrackState
        The track's.
    found : pair of (ImageTip or None)
        What both views show.
    alike : bool
        Whether the needle stands out as it did.
    possible : bool
        Whether it can stand out so much at all.
    near : bool
        Whether it lies on the needle's way, and where it should have got to.
    guided : bool
        Whether one view's end was found from what the other shows and the needle's way.
    come : bool
        Whether it has come and needs no further sight: nothing else says how far the needle goes,
        or the phantom was seen without it and it has not been found yet.

    Returns
    -------
    int or None
        0 where one will do, None where it is not seen well enough for any number.
    """
    if come or (near and alike and is_sound(found, _NEAR_PX, _NEAR_ALONG_PX)):
        return 0
    more = 0 if alike else _MORE_UNLIKE
    if is_sound(found, SOUND_PX, SOUND_ALONG_PX):
        if state is TrackState.LOST:
            return _SOUND_SIGHTS + more
        return 0 if possible else _SOUND_SIGHTS
    if (near or guided) and is_half_sound(found):
        return _SOUND_SIGHTS + more
    if not (near and alike) and not is_sound(found, CLEAR_PX, CLEAR_ALONG_PX):
        return None
    return _UNSOUND_SIGHTS + more + (_MORE_TRACKING if state is TrackState.TRACKING else 0)
