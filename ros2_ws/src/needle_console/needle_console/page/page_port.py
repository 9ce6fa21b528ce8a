"""Port `page`: passes events of the pages to the component, and its updates to the pages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from needle_console.console import (
    CameraImage,
    HoldRequest,
    PageEvent,
    PageUpdate,
    SimulationLag,
    ViewRequest,
)
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.page_session import RELEASED, PageHold
from needle_console.view.advice import Button
from needle_console.view.camera_view import CameraView
from needle_console.view.snapshot import Array, Snapshot
from needle_core.component import Batch, Log
from needle_core.messages import HOLD_LIFETIME, Point, Pose
from needle_core.rotations import quaternion_from_rotation
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views


class PagePort:
    """Connects the threads of page and hold with the component's runner, without blocking.

    Parameters
    ----------
    settings : ConsoleParameters
        The component's parameters.
    clock : callable
        Returns the monotonic real time [s], also in a simulation.

    Attributes
    ----------
    refusals : callable
        Returns the number of refusals of each kind by the hold's server.
    """

    def __init__(
        self, settings: ConsoleParameters, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._arrive: Callable[[Batch], None] = lambda _: None
        self._lock = threading.Lock()
        self._events: list[PageEvent] = []
        self._hold: PageHold | None = None
        self._hold_at = 0.0
        self._was_released = False
        self._snapshot = Snapshot()
        self._view = CameraView(_cameras(settings.calibration_file), self.snapshot)
        self.refusals: Callable[[], Mapping[str, int]] = dict

    # ---- for the component's runner -------------------------------------------------------------

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Pass events to `arrive` from now on."""
        self._arrive = arrive

    def send(self, batch: Sequence[PageUpdate]) -> None:
        """Update the pages."""
        for update in batch:
            if isinstance(update, CameraImage):
                self._view.set_image(update.side, update.image, self._clock())
            else:
                self._snapshot = update

    def close(self) -> None:
        """Do nothing: the threads belong to the servers of page and hold."""

    def _pop_events(self) -> tuple[PageEvent, ...]:
        """Return the events since the last call.

        The newest hold counts, unless one of them was a release; the next one follows soon. The age
        of a hold is measured in real time: an old one does not count, even in a slow simulation.
        """
        with self._lock:
            events, self._events = self._events, []
            hold, self._hold = self._hold, None
            was_released, self._was_released = self._was_released, False
            is_old = self._clock() - self._hold_at > HOLD_LIFETIME
        if hold is not None:
            counts = not was_released and not is_old
            events.append(HoldRequest(hold if counts else RELEASED, self.refusals()))
        return tuple(events)

    def set_lag(self, seconds: float) -> None:
        """Report the lag of a simulation behind the clock [s]."""
        self._add(SimulationLag(seconds))

    # ---- for the hold's thread ------------------------------------------------------------------

    def set_hold(self, hold: PageHold) -> None:
        """Set the valid hold."""
        with self._lock:
            self._hold, self._hold_at = hold, self._clock()
            self._was_released |= not hold.pressed
        self._arrive(self._pop_events)

    def hold_refusal(self, is_local: bool) -> str:
        """Return the reason why a page, `is_local` or remote, may only watch and stop, if any."""
        device = self._snapshot.device
        simulated = None if device is None else device.simulated
        return self._settings.hold_refusal(simulated, is_local=is_local)

    def log(self, text: str, severity: str = "warning") -> None:
        """Add a line to the log."""
        self._add(Log(severity, text))

    # ---- for the page's thread ------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return the newest state of the rig."""
        return self._snapshot

    def view(self, side: str) -> bytes | None:
        """Return the newest view of a side (`left`, `right`) as JPEG; None if there is none."""
        self._add(ViewRequest())
        return self._view.jpeg(side, self._clock())

    def press(self, button: Button) -> None:
        """Press a button that calls a service."""
        self._add(button)

    def send_plane(self, pose: Array) -> None:
        """Send a target plane, T_rig_plane, shape (4, 4)."""
        # The stamp is 0, because the pose was not measured.
        orientation = quaternion_from_rotation(pose[:3, :3].tolist())
        self._add(Pose(0, "rig", _vector(pose[:3, 3]), orientation))

    def send_point(self, point: Array) -> None:
        """Send a target point in `rig`, shape (3,) [m]."""
        self._add(Point(0, "rig", _vector(point)))

    def _add(self, event: PageEvent) -> None:
        with self._lock:
            self._events.append(event)
        self._arrive(self._pop_events)


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _cameras(file: str) -> dict[str, Any]:
    left, right = stereo_views(load_calibration(file))
    return {"left": left, "right": right}
