"""Cameras that render in a process of their own: sim_rig goes on meanwhile, in real time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from typing import Any, ClassVar

from needle_core.component import Actions, Moment, Port, Publish
from needle_core.process.worker import start_worker
from needle_sim.camera_sensor import CAMERAS, DistantCameras, Exposure, StereoCameras
from needle_sim.rig.bench import SimulatedBench
from needle_sim.sim_rig_parameters import SimRigParameters

_MOST_UNDER_WAY = 2


class RenderedCameras(DistantCameras):
    """Levels with cameras: exposures go out at the port `cameras`, and images come back.

    Exposures that come faster than they are rendered are lost, as a camera loses frames.
    """

    outputs = StereoCameras.outputs

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        super().__init__(bench, settings)
        self._under_way = 0
        self.ports = (Port(CAMERAS, self._on_images),)

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the exposure itself."""
        if self._under_way < _MOST_UNDER_WAY:
            self._under_way += 1
            yield from super().expose(number, stamp_ns)

    def _on_images(self, batch: Sequence[Sequence[Publish]], at: Moment) -> Actions:
        for images in batch:
            self._under_way -= 1
            yield from images


class RenderingProcess:
    """The process that renders: the real port `cameras`.

    Parameters
    ----------
    settings : SimRigParameters
        The rig's.
    """

    _cameras: ClassVar[StereoCameras]
    """Those of the process that renders."""

    def __init__(self, settings: SimRigParameters) -> None:
        self._pool = start_worker(RenderingProcess._begin, settings)

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Begin to hand over images."""
        self._arrive = arrive

    def send(self, batch: tuple[Exposure, ...]) -> None:
        """Render exposures, one after the other."""
        with contextlib.suppress(BrokenProcessPool):
            for exposure in batch:
                self._pool.submit(RenderingProcess._render, exposure).add_done_callback(self._take)

    def close(self) -> None:
        """Complete what the cameras write, and end."""
        with contextlib.suppress(BrokenProcessPool):
            self._pool.submit(RenderingProcess._end)
        self._pool.shutdown(wait=True)

    def _take(self, done: Future[list[Publish]]) -> None:
        if not done.cancelled() and done.exception() is None:
            self._arrive((done.result(),))

    @staticmethod
    def _begin(settings: SimRigParameters) -> None:
        RenderingProcess._cameras = StereoCameras(settings)

    @staticmethod
    def _render(exposure: Exposure) -> list[Publish]:
        return list(RenderingProcess._cameras.render(exposure))

    @staticmethod
    def _end() -> None:
        RenderingProcess._cameras.close()
