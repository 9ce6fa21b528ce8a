"""The rig as components in this process, on a virtual clock: the run of `simulate`."""

from __future__ import annotations

import importlib
import math
import random
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from needle_bags.recording.bag_tap import BagTap
from needle_bringup.simulated_operator.component import (
    SimulatedOperator,
    SimulatedOperatorParameters,
)
from needle_bringup.simulated_operator.progress import Progress
from needle_controller.plane_controller import PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.can_frame import CAN
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED
from needle_core.component import Action, Component, Exit, Output, Publish
from needle_core.errors import UserError
from needle_core.runners.paced import PacedRunner
from needle_core.runners.process import Compute, uniform
from needle_core.runners.virtual import DIAGNOSTICS, LOG, VirtualRunner
from needle_core.settings.parameter_fields import from_values
from needle_core.settings.parameter_files import Parameters
from needle_core.status_messages import ControllerStatus
from needle_sim.bench import SimulatedBench
from needle_sim.sensors import Sensor, make_sensor
from needle_sim.sim_rig import SimRig
from needle_sim.sim_rig_parameters import SimRigParameters

if TYPE_CHECKING:
    from needle_tracker.stereo_tracker import StereoTipTracker

_FOLLOWING, _SEARCH = (0.03, 0.05), (0.3, 0.9)
"""Compute time of the tracker for an image pair with and without a tip, on two shared cores [s]."""
_SLICE = 1.0
_END_TIMEOUT = 5.0
"""Time for the rig to end after the operator [s]."""
# Parameters of the CAN adapter, which the virtual bus replaces.
_ADAPTER_PARAMETERS = ("pty",)


def make_components(parameters: Parameters) -> list[Component]:
    """Return the rig of a level with its simulated operator; errors are those of `make_rig`."""
    operator = settings_of(SimulatedOperatorParameters, parameters, "simulated_operator")
    return [*make_rig(parameters), SimulatedOperator(operator)]


def make_tracker(parameters: Parameters) -> StereoTipTracker:
    """Return the tracker."""
    # Import late, because a run without images does not need OpenCV.
    from needle_tracker import stereo_tracker  # noqa: PLC0415
    from needle_tracker.tracker_parameters import StereoTrackerParameters  # noqa: PLC0415

    settings = settings_of(StereoTrackerParameters, parameters, "stereo_tracker")
    return stereo_tracker.make_tracker(settings)


def make_rig(
    parameters: Parameters,
    new_sensor: Callable[[SimulatedBench, SimRigParameters], Sensor] = make_sensor,
    new_tracker: Callable[[Parameters], Component] = make_tracker,
) -> list[Component]:
    """Return the rig of a level.

    Parameters
    ----------
    parameters : Parameters
        Parameters by node.
    new_sensor, new_tracker : callable
        Functions that create the sensor, and the tracker if there are images.

    Raises
    ------
    UserError
        If a parameter is unknown or out of bounds.
    """
    rig = SimRig(settings_of(SimRigParameters, parameters, "sim_rig"), new_sensor=new_sensor)
    level = rig.settings.level
    return [
        rig,
        *(_make_drives(parameters) if level == "drive" else []),
        *([] if level == "tip" else [new_tracker(parameters)]),
        PlaneController(settings_of(SteeringSettings, parameters, "plane_controller")),
    ]


def _make_drives(parameters: Parameters) -> list[Component]:
    # Import late, because only level drive needs these modules.
    from needle_device_driver.device_driver import DeviceDriver  # noqa: PLC0415
    from needle_device_driver.parameters import DeviceDriverParameters  # noqa: PLC0415
    from needle_sim.drive_emulator import (  # noqa: PLC0415
        DriveEmulator,
        DriveEmulatorParameters,
    )

    def settings(kind: type[Any], node: str, **own: str) -> Any:
        given = parameters.get(node, {}).items()
        values = {k: v for k, v in given if k not in _ADAPTER_PARAMETERS}
        return settings_of(kind, {node: {**values, **own}}, node)

    driver = settings(DeviceDriverParameters, "device_driver", link="virtual", channel=CAN)
    return [
        DriveEmulator(settings(DriveEmulatorParameters, "drive_emulator")),
        DeviceDriver(driver),
    ]


def own_component(given: str) -> Component:
    """Return an instance of the class `MODULE:NAME`, created without arguments.

    Modules in the current folder are found as well.

    Raises
    ------
    UserError
        If there is no such class, or it is not a component.
    """
    module_name, _, name = given.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        make = getattr(importlib.import_module(module_name), name)
        component = make()
    except (ImportError, AttributeError, TypeError) as error:
        raise UserError(f"--component {given}: {error}") from error
    finally:
        sys.path.pop(0)
    if not isinstance(component, Component):
        raise UserError(f"--component {given}: makes a {type(component).__name__}, not a Component")
    return component


def _tracker_time(actions: Sequence[Action], rng: random.Random) -> float:
    """Return the compute time of a handler of the tracker [s]; an image pair takes longest."""
    seconds = rng.uniform(1e-4, 3e-4)
    for action in actions:
        if isinstance(action, Publish) and action.topic == "needle/tip_pose":
            found = math.isfinite(action.message.covariance[0])
            seconds += rng.uniform(*(_FOLLOWING if found else _SEARCH))
    return seconds


COMPUTE: Mapping[str, Compute] = {
    "plane_controller": uniform(1e-3, 3e-3),
    "stereo_tracker": _tracker_time,
}
"""Compute time of the handlers by component, as measured on two shared cores."""


def run_virtually(
    components: list[Component],
    bag: Path,
    *,
    seed: int,
    run_info: Mapping[str, Any],
    real_time_factor: float,
    check: Callable[[], None],
) -> None:
    """Run the rig until the operator ends, and record it.

    Parameters
    ----------
    components : list of Component
        The rig.
    bag : Path
        Folder of the bag.
    seed : int
        Seed of latencies and compute times.
    run_info : mapping
        Description of the run in the bag.
    real_time_factor : float
        Ratio of virtual to real time; 0 for as fast as possible.
    check : callable
        Called regularly; raises KeyboardInterrupt to end the run.

    Raises
    ------
    UserError
        If the rig did not become ready, or a component ended before the operator.
    """
    tap, progress = BagTap(bag, components, (DIAGNOSTICS, LOG), run_info), Progress(sys.stderr)

    def show(stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        if isinstance(message, ControllerStatus):
            progress.show(message)

    kind = partial(PacedRunner, pace=real_time_factor) if real_time_factor else VirtualRunner
    runner = kind(components, seed, compute=COMPUTE, taps=(tap, show))
    operator = SimulatedOperator.name
    try:
        while not runner.run(_SLICE):
            check()
        _check_exits(runner.exits, operator)
    except KeyboardInterrupt:
        runner.stop(operator)
        runner.run(_END_TIMEOUT)
        raise
    finally:
        ended = runner.exits.get(operator)
        progress.close(f"{operator}: {ended.text}" if ended else "")
        tap.close()


def _check_exits(exits: Mapping[str, Exit], operator: str) -> None:
    for name, ended in exits.items():
        if name != operator or ended.code not in (EXIT_DONE, EXIT_MISSED):
            raise UserError(f"{name} ended with exit code {ended.code}: {ended.text}")


def settings_of(kind: type[Any], parameters: Parameters, node: str) -> Any:
    """Return a component's settings from the parameters of its node."""
    return from_values(kind, parameters.get(node, {}), node)
