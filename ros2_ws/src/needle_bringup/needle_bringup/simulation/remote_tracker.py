"""Cameras and tracker of a simulated rig in a second process, behind a port."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

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


def make_vision(parameters: Parameters) -> Callable[[tuple[Item, Moment]], list[Action]]:
    """Return the function that passes inputs to cameras and tracker in another process."""
    cameras = StereoCameras(settings_of(SimRigParameters, parameters, "sim_rig"))
    tracker = make_tracker(parameters)
    handlers = {row.topic: row.handler for row in tracker.inputs}

    def handle(given: tuple[Item, Moment]) -> list[Action]:
        item, at = given
        if item is None:
            return list(tracker.check(at))
        if isinstance(item, m.JointState):
            return list(handlers["joint_states"](item, at))
        actions: list[Action] = []
        for image in cameras.render(item):
            actions += [image, *handlers[image.topic](image.message, at)]
        return actions

    return handle


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

    def _on_results(self, batch: Sequence[list[Action]], at: Moment) -> Actions:
        for actions in batch:
            self._pending.popleft()
            yield from actions

    def _on_change(self, change: PortChange, at: Moment) -> Actions:
        yield Exit(EXIT_MISSED, change.lost)
