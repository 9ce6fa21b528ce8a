"""Port `page` on real pages: what a person does goes in, what is shown comes out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from needle_console.console import Hand, Lag, Looked, PageEvent, Shown, View
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_state import RELEASED, HoldState
from needle_console.view.advice import Button
from needle_console.view.camera_feed import CameraFeed
from needle_console.view.snapshot import Array, Snapshot
from needle_core.component import Batch, Log
from needle_core.files.installed import find_shared_file
from needle_core.messages import HOLD_LIFETIME, Point, Pose, quaternion_from_rotation
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views

_MOST_WISHES = 50


class Desk:
    """Between the threads of page and hold, and whoever runs the component; nothing in here waits.

    Parameters
    ----------
    settings : ConsoleParameters
        The component's.
    clock : callable, optional
        Returns the steady time [s], of the wall and not of a simulation; the system's by default.

    Attributes
    ----------
    refused : callable
        Returns how often the hold's server refused or lost what.
    """

    def __init__(
        self, settings: ConsoleParameters, clock: Callable[[], float] | None = None
    ) -> None:
        self._settings = settings
        self._clock = clock or time.monotonic
        self._arrive: Callable[[Batch], None] = lambda _: None
        self._lock = threading.Lock()
        self._wishes: list[PageEvent] = []
        self._hold: HoldState | None = None
        self._hold_at = 0.0
        self._was_released = False
        self._snapshot = Snapshot()
        self._feed = CameraFeed(_cameras(settings.calibration_file), self.snapshot)
        self.refused: Callable[[], Mapping[str, int]] = dict

    # ---- for the component's runner -------------------------------------------------------------

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Begin to hand over what comes in."""
        self._arrive = arrive

    def send(self, batch: Sequence[Shown]) -> None:
        """Take what pages show."""
        for shown in batch:
            if isinstance(shown, View):
                self._feed.put(shown.side, shown.image, self._clock())
            else:
                self._snapshot = shown

    def close(self) -> None:
        """Do nothing: who has threads here ends them."""

    def _take(self) -> tuple[PageEvent, ...]:
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
        return tuple(events)

    def note_lag(self, seconds: float) -> None:
        """Take how far a simulation is behind the clock [s]."""
        self._put(Lag(seconds))

    # ---- for the hold's thread ------------------------------------------------------------------

    def hold(self, state: HoldState) -> None:
        """Take the hold that counts."""
        with self._lock:
            self._hold, self._hold_at = state, self._clock()
            self._was_released |= not state.pressed
        self._arrive(self._take)

    def why_no_hold(self, is_local: bool) -> str:
        """Return why a page may only watch, and stop; takes whether it is on the rig's machine."""
        device = self._snapshot.device
        simulated = None if device is None else device.simulated
        return self._settings.why_no_hold(simulated, is_local=is_local)

    def notice(self, text: str, severity: str = "warning") -> None:
        """Take a line for the log."""
        self._put(Log(severity, text))

    # ---- for the page's thread ------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return the rig as it is now."""
        return self._snapshot

    def picture(self, side: str) -> bytes | None:
        """Return a side's (`left`, `right`) newest view as JPEG; None where there is none."""
        self._put(Looked())
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
        self._arrive(self._take)


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _cameras(file: str) -> dict[str, Any]:
    path = (
        Path(file).expanduser()
        if file
        else find_shared_file("needle_tracker", "config/calibration.yaml")
    )
    left, right = stereo_views(load_calibration(path))
    return {"left": left, "right": right}
