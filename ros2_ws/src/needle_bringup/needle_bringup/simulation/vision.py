"""Cameras and tracker of a simulated rig in a process of their own, behind a port."""

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

EYES = "eyes"
"""Name of the port between the tracker's stand-in and the process that works."""
_MOST_EXPOSURES = 2
_CHECK_PERIOD = 0.05

Item = Exposure | m.JointState | None
"""What is handed on; None: time alone."""
Done = Future[list[Action]]


class Eyes:
    """Cameras and tracker, in the process that works: what comes in, and what comes of it.

    Parameters
    ----------
    parameters : Parameters
        Node to its parameters.
    """

    here: ClassVar[Eyes]
    """Those of this process."""

    def __init__(self, parameters: Parameters) -> None:
        self._cameras = StereoCameras(settings_of(SimRigParameters, parameters, "sim_rig"))
        self._tracker = make_tracker(parameters)
        self._handlers = {row.topic: row.handler for row in self._tracker.inputs}

    @staticmethod
    def open(parameters: Parameters) -> None:
        """Make those of this process."""
        Eyes.here = Eyes(parameters)

    @staticmethod
    def work(item: Item, at: Moment) -> list[Action]:
        """Return what comes of an exposure, of joints, or of time alone."""
        return list(Eyes.here.handle(item, at))

    def handle(self, item: Item, at: Moment) -> Iterable[Action]:
        """Return what comes of an exposure, of joints, or of time alone."""
        match item:
            case Exposure():
                for image in self._cameras.render(item):
                    yield image
                    yield from self._handlers[image.topic](image.message, at)
            case m.JointState():
                yield from self._handlers["joint_states"](item, at)
            case _:
                yield from self._tracker.check(at)


class EyesProcess:
    """The process of `Eyes`: the real port `eyes`.

    Parameters
    ----------
    parameters : Parameters
        Node to its parameters.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._pool = start_worker(Eyes.open, parameters)

    def open(self, arrive: Callable[[tuple[Done] | PortChange], None]) -> None:
        """Begin to hand over what is done."""
        self._arrive = arrive

    def send(self, batch: Sequence[tuple[Item, Moment]]) -> None:
        """Take work to do."""
        try:
            for item, at in batch:
                done = self._pool.submit(Eyes.work, item, at)
                done.add_done_callback(lambda done: self._arrive((done,)))
        except BrokenProcessPool:
            self._arrive(PortChange("the process that renders and tracks has ended"))

    def close(self) -> None:
        """End it, when what it does is done."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class DistantTracker(Component):
    """Stands for the tracker where that works in a process of its own, and for its images.

    It hands on exposures, joint states and time, and sends what comes back. Exposures that come
    faster than they are worked off are lost, as a camera loses frames.
    """

    name = "stereo_tracker"

    def __init__(self) -> None:
        # Of what is under way, in order: whether it is an exposure.
        self._under_way: deque[bool] = deque()
        self.inputs = (Input("joint_states", m.JointState, self._hand_on, JOINT_STATES),)
        self.outputs = (
            *StereoCameras.outputs,
            Output(TIP, m.Point),
            Output(TIP_POSE, m.PoseWithCovariance),
            Output(CALIBRATION, m.Text, LATCHED),
        )
        self.ports = (Port(CAMERAS, self._on_exposures), Port(EYES, self._on_done, self._on_change))
        self.timers = (Timer(_CHECK_PERIOD, partial(self._hand_on, None)),)

    def _hand_on(self, item: Item, at: Moment) -> Actions:
        self._under_way.append(isinstance(item, Exposure))
        yield Send(EYES, ((item, at),))

    def _on_exposures(self, batch: Sequence[Exposure], at: Moment) -> Actions:
        for exposure in batch:
            if sum(self._under_way) < _MOST_EXPOSURES:
                yield from self._hand_on(exposure, at)

    def _on_done(self, batch: Sequence[Done], at: Moment) -> Actions:
        for done in batch:
            self._under_way.popleft()
            yield from done.result()

    def _on_change(self, change: PortChange, at: Moment) -> Actions:
        yield Exit(EXIT_MISSED, change.lost)
