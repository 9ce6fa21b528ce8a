"""Cameras and tracker of a simulated rig in a second process, behind a port."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import ClassVar

from needle_bringup.simulation.virtual_run import make_tracker, settings_of
from needle_core import messages as m
from needle_core.commands.cli import EXIT_MISSED
from needle_core.component import (
    JOINT_STATES,
    LATCHED,
    Action,
    Actions,
    Component,
    Exit,
    Input,
    Moment,
    Output,
    Port,
    PortChange,
    Send,
    Timer,
)
from needle_core.process.worker import start_worker
from needle_core.settings.parameter_files import Parameters
from needle_sim.cameras import CAMERAS, Exposure, StereoCameras
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.stereo_tracker import CALIBRATION, TIP, TIP_POSE

VISION = "vision"
"""Name of the port between `RemoteTracker` and its process."""
_MAX_EXPOSURES = 2
_CHECK_PERIOD = 0.05

Item = Exposure | m.JointState | None
"""Input of the process; None is a timer tick."""
Done = Future[list[Action]]


class VisionWorker:
    """Cameras and tracker inside the second process.

    Parameters
    ----------
    parameters : Parameters
        Parameters by node.
    """

    instance: ClassVar[VisionWorker]
    """The only instance in the process."""

    def __init__(self, parameters: Parameters) -> None:
        self._cameras = StereoCameras(settings_of(SimRigParameters, parameters, "sim_rig"))
        self._tracker = make_tracker(parameters)
        self._handlers = {row.topic: row.handler for row in self._tracker.inputs}

    @staticmethod
    def open(parameters: Parameters) -> None:
        """Create the instance of this process."""
        VisionWorker.instance = VisionWorker(parameters)

    @staticmethod
    def work(item: Item, at: Moment) -> list[Action]:
        """Return the actions of cameras and tracker for an input."""
        return list(VisionWorker.instance.handle(item, at))

    def handle(self, item: Item, at: Moment) -> Iterable[Action]:
        """Return the actions of cameras and tracker for an input."""
        match item:
            case Exposure():
                for image in self._cameras.render(item):
                    yield image
                    yield from self._handlers[image.topic](image.message, at)
            case m.JointState():
                yield from self._handlers["joint_states"](item, at)
            case _:
                yield from self._tracker.check(at)


class VisionProcess:
    """Process of a `VisionWorker`: the real port `vision`.

    Parameters
    ----------
    parameters : Parameters
        Parameters by node.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._pool = start_worker(VisionWorker.open, parameters)

    def open(self, arrive: Callable[[tuple[Done] | PortChange], None]) -> None:
        """Pass results to `arrive` from now on."""
        self._arrive = arrive

    def send(self, batch: Sequence[tuple[Item, Moment]]) -> None:
        """Submit inputs."""
        try:
            for item, at in batch:
                done = self._pool.submit(VisionWorker.work, item, at)
                done.add_done_callback(lambda done: self._arrive((done,)))
        except BrokenProcessPool:
            self._arrive(PortChange("the process that renders and tracks has ended"))

    def close(self) -> None:
        """End the process after its current input."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class RemoteTracker(Component):
    """Proxy of cameras and tracker in the second process.

    It passes on exposures, joint states and timer ticks, and publishes the results. Exposures that
    arrive faster than they are processed are dropped, as by a camera.
    """

    name = "stereo_tracker"

    def __init__(self) -> None:
        # Whether each pending input is an exposure, in order.
        self._pending: deque[bool] = deque()
        self.inputs = (Input("joint_states", m.JointState, self._submit, JOINT_STATES),)
        self.outputs = (
            *StereoCameras.outputs,
            Output(TIP, m.Point),
            Output(TIP_POSE, m.PoseWithCovariance),
            Output(CALIBRATION, m.Text, LATCHED),
        )
        self.ports = (
            Port(CAMERAS, self._on_exposures),
            Port(VISION, self._on_results, self._on_change),
        )
        self.timers = (Timer(_CHECK_PERIOD, partial(self._submit, None)),)

    def _submit(self, item: Item, at: Moment) -> Actions:
        self._pending.append(isinstance(item, Exposure))
        yield Send(VISION, ((item, at),))

    def _on_exposures(self, batch: Sequence[Exposure], at: Moment) -> Actions:
        for exposure in batch:
            if sum(self._pending) < _MAX_EXPOSURES:
                yield from self._submit(exposure, at)

    def _on_results(self, batch: Sequence[Done], at: Moment) -> Actions:
        for done in batch:
            self._pending.popleft()
            yield from done.result()

    def _on_change(self, change: PortChange, at: Moment) -> Actions:
        yield Exit(EXIT_MISSED, change.lost)
