"""Port `page` on real pages: what a person does goes in, what is shown comes out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from needle_console.console import Hand, Lag, PageEvent, Shown, View
from needle_console.hold.hold_state import RELEASED, HoldState
from needle_console.view.advice import Button
from needle_console.view.camera_feed import CameraFeed
from needle_console.view.snapshot import Array, Snapshot
from needle_core.component import Log
from needle_core.files.installed import find_shared
from needle_core.messages import HOLD_LIFETIME, Point, Pose
from needle_core.rotations import quaternion_from_rotation
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views

_MOST_WISHES = 50


class Desk:
    """Between the threads of page and hold, and whoever runs the component; nothing in here waits.

    Parameters
    ----------
    calibration_file : str
        Calibration of the cameras; empty: needle_tracker's own.
    ring : callable
        Called by any thread when something has come in.
    clock : callable, optional
        Returns the steady time [s], of the wall and not of a simulation; the system's by default.

    Attributes
    ----------
    refused : callable
        Returns how often the hold's server refused or lost what.
    """

    def __init__(
        self,
        calibration_file: str,
        ring: Callable[[], None],
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._ring = ring
        self._clock = clock or time.monotonic
        self._lock = threading.Lock()
        self._wishes: list[PageEvent] = []
        self._hold: HoldState | None = None
        self._hold_at = 0.0
        self._was_released = False
        self._snapshot = Snapshot()
        self._feed = CameraFeed(_cameras(calibration_file), self.snapshot)
        self.refused: Callable[[], Mapping[str, int]] = dict

    # ---- for the component's runner -------------------------------------------------------------

    def take(self) -> Sequence[PageEvent]:
        """Return what has come in since the last time.

        Of holds the newest counts, unless one was a release: the next one is not far. They age on
        the clock of the person's hand: what has waited here for too long is none, however slow a
        simulation is.
        """
        with self._lock:
            events, self._wishes = self._wishes, []
            hold, self._hold = self._hold, None
            was_released, self._was_released = self._was_released, False
            is_old = self._clock() - self._hold_at > HOLD_LIFETIME
        if hold is not None:
            counts = not was_released and not is_old
            events.append(Hand(hold if counts else RELEASED, self.refused()))
        return events

    def send(self, batch: Sequence[Shown]) -> None:
        """Take what pages show."""
        for shown in batch:
            if isinstance(shown, View):
                self._feed.put(shown.side, shown.image, self._clock())
            else:
                self._snapshot = shown

    @property
    def wants_images(self) -> bool:
        """Whether a page asks for views."""
        return self._feed.wanted(self._clock())

    def note_lag(self, seconds: float) -> None:
        """Take how far a simulation is behind the clock [s]."""
        self._put(Lag(seconds))

    # ---- for the hold's thread ------------------------------------------------------------------

    def hold(self, state: HoldState) -> None:
        """Take the hold that counts."""
        with self._lock:
            self._hold, self._hold_at = state, self._clock()
            self._was_released |= not state.pressed
        self._ring()

    def notice(self, text: str) -> None:
        """Take a line that is worth a warning."""
        self._put(Log("warning", text))

    # ---- for the page's thread ------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return the rig as it is now."""
        return self._snapshot

    def picture(self, side: str) -> bytes | None:
        """Return a side's (`left`, `right`) newest view as JPEG; None where there is none."""
        return self._feed.picture(side, self._clock())

    def press(self, button: Button) -> None:
        """Take a press of a button that calls a service."""
        self._put(button)

    def send_plane(self, pose: Array) -> None:
        """Take a target plane, T_rig_plane, shape (4, 4)."""
        # Placed by hand, and not seen at a time: no stamp.
        orientation = quaternion_from_rotation(pose[:3, :3].tolist())
        self._put(Pose(0, "rig", _vector(pose[:3, 3]), orientation))

    def send_point(self, point: Array) -> None:
        """Take a target point in `rig`, shape (3,) [m]."""
        self._put(Point(0, "rig", _vector(point)))

    def _put(self, event: PageEvent) -> None:
        with self._lock:
            if len(self._wishes) < _MOST_WISHES:
                self._wishes.append(event)
        self._ring()


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _cameras(file: str) -> dict[str, Any]:
    path = (
        Path(file).expanduser()
        if file
        else find_shared("needle_tracker", "config/calibration.yaml")
    )
    left, right = stereo_views(load_calibration(path))
    return {"left": left, "right": right}
