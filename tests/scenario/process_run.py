"""One run of the rig as real processes, some of which are killed or stopped."""

from __future__ import annotations

import random
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState, Joy
from trajectory_msgs.msg import JointTrajectory

from campaign.trials.ros_rig_client import RosRigClient, ros
from campaign.trials.trial_processes import TrialProcesses, graph_in_real_time
from needle_core.convert import from_ros
from needle_core.errors import UserError
from needle_core.messages import HoldState
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.ros.base_node import RELIABLE, to_qos, values_of
from needle_core.status_messages import DeviceStatus
from needle_device_driver.device import HOLDS
from needle_device_driver.supervisor.limits import SafetyLimits
from scenario.faults import Fault, Kind
from scenario.monitors.invariants import RELEASE_BOUND, InvariantMonitor
from scenario.parts.operator_model import OUT
from scenario.rig_run import RunResult

PERSON = "simulated_operator"
PARTS = ("device_driver", "plane_controller", "stereo_tracker", PERSON)
# Messages of the simulated operator do not have the lifetime of 0.1 s that those of the operator
# node have: its hold lasts for the driver's own 0.25 s.
_RELEASE_BOUND = RELEASE_BOUND - 0.1 + 0.25
_MOST = 3
_LATEST, _SHORTEST, _LONGEST = 3.0, 0.05, 3.0
_DEEP_ENOUGH = 0.002
_START, _DRAW_OUT, _STILL = 120.0, 60.0, 1.0
# Gap that shows that drive time was paused: they publish with each SYNC of the driver [s].
_WITHOUT_SYNC = 0.1


class ProcessMonitor(RosRigClient):
    """Checks holds, status and motors; withdraws the needle on request.

    Times are source time stamps, so that its own lateness has no effect. It checks motion from the
    first hold on, because DDS may deliver that later to it than to the driver.

    Attributes
    ----------
    watch : InvariantMonitor
        The invariants.
    """

    def __init__(self) -> None:
        self.watch = InvariantMonitor(SafetyLimits(), _RELEASE_BOUND)
        self._begun = time.time()
        self._received_hold = False
        super().__init__("sim/drive_positions")
        # Source whose press moves the needle.
        self._holder = PERSON
        self.create_subscription(Joy, "device/hold", self._on_hold, to_qos(HOLDS))
        self.create_subscription(
            JointTrajectory, "device/joint_trajectory", self._on_command, RELIABLE
        )

    @property
    def now(self) -> float:
        """System time since the start of the run [s]."""
        return time.time() - self._begun

    def draw_out(self) -> None:
        """Reset and enable the device, then hold until the needle is out.

        Raises
        ------
        UserError
            If the needle does not come out.
        """
        self._holder = self.get_name()
        end = self.now + _DRAW_OUT
        while self.insertion > OUT:
            state, activity = self.status.get("state"), self.status.get("activity")
            if self.now > end:
                raise UserError(f"it is {self.insertion * 1e3:.2f} mm in; {self.status}")
            if state in ("FAULT", "ESTOPPED"):
                self.pressed = False
                self.call("device/reset")
            elif state == "DISABLED":
                self.call("device/enable", True)
            elif self.status.get("hold_owner") != self.get_name():
                # A hold that does not count must be released first.
                self.pressed = not self.pressed
            elif activity != "retraction":
                self.call("device/retract")
            self.pause(0.2)
        self.pressed = False
        self.until(lambda: self.status.get("hold_owner", "") == "", "the hold is off")

    def _on_hold(self, message: Joy, info: dict[str, int]) -> None:
        hold = from_ros(HoldState, message)
        if hold.source == self._holder:
            self._received_hold = True
            pressed, at = hold.pressed, self._sent_at(info)
            self.watch.observe_hand(at, holds=pressed)
            if pressed:
                self.watch.observe_hold(at)

    def _on_command(self, message: JointTrajectory) -> None:
        self.watch.observe_command([(at.positions[0], at.positions[1]) for at in message.points])

    def _on_joints(self, message: JointState, info: dict[str, int]) -> None:
        before = self.positions[-1].time if self.positions else 0.0
        super()._on_joints(message, info)
        at = self.positions[-1]
        moved_at = at.time - self._begun
        if at.time - before > _WITHOUT_SYNC:
            self.watch.observe_drives_resumed(moved_at)
        if self._received_hold:
            self.watch.observe_motors(moved_at, at.insertion, at.rotation)

    def _sent_at(self, info: dict[str, int]) -> float:
        return info["source_timestamp"] * 1e-9 - self._begun

    def _on_status(self, message: DiagnosticStatus) -> None:
        super()._on_status(message)
        self.watch.observe_device(self.now, DeviceStatus.parse(values_of(message)))


def processes_schedule_of(seed: int) -> list[Fault]:
    """Draw the faults of the processes; times start when the needle is steered [s]."""
    draw = random.Random(f"faults of processes {seed}")
    faults = []
    for _ in range(draw.randint(1, _MOST)):
        part, kind = draw.choice(PARTS), draw.choice((Kind.OFF, Kind.STUCK))
        at, share = draw.uniform(0.0, _LATEST), draw.random()
        faults.append(Fault(part, kind, at, _SHORTEST * (_LONGEST / _SHORTEST) ** share, 0.0))
    return sorted(faults, key=lambda fault: fault.at)


def results_of_processes(seeds: range, folder: Path | None) -> Iterator[RunResult]:
    """Yield the results of runs of real processes; keep the files of a violating run."""
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="needle_soak_") as name:
            result = run_processes(seed, Path(name))
            if result.violations and folder is not None:
                shutil.copytree(name, folder / f"processes_{seed}", dirs_exist_ok=True)
            yield result


def run_processes(seed: int, folder: Path, faults: Sequence[Fault] | None = None) -> RunResult:
    """Run the rig in real time, in a ROS domain of its own.

    Parameters
    ----------
    seed : int
        Seed of the simulation and the faults.
    folder : Path
        For the logs of the nodes.
    faults : sequence of Fault, optional
        Faults instead of those of the seed.
    """
    happened = tuple(processes_schedule_of(seed) if faults is None else faults)
    with (
        reserve_domain_id() as domain,
        ros(domain),
        closing(ProcessMonitor()) as monitor,
        closing(TrialProcesses(folder, domain, graph_in_real_time(seed))) as graph,
    ):
        _insert(monitor, graph, happened)
        violations = tuple(monitor.watch.violations)
        return RunResult(seed, happened, violations, happened, monitor.now, of_processes=True)


def _insert(monitor: ProcessMonitor, graph: TrialProcesses, faults: Sequence[Fault]) -> None:
    monitor.until(lambda: monitor.insertion > _DEEP_ENOUGH, "steering", _START)
    begun = monitor.now
    events: list[tuple[float, Callable[[], None]]] = []
    for fault in faults:
        for at, happen in ((fault.at, _begin), (fault.at + fault.lasts, _end)):
            events.append((begun + at, partial(happen, monitor, graph, fault)))
    for at, act in sorted(events, key=lambda event: event[0]):
        monitor.pause(max(at - monitor.now, 0.0))
        act()
    monitor.pause(_STILL)
    # From here on, the monitor is the only operator.
    graph.end(PERSON)
    try:
        monitor.draw_out()
    except UserError as error:
        monitor.watch.violate("run_can_continue", monitor.now, str(error))


def _begin(monitor: ProcessMonitor, graph: TrialProcesses, fault: Fault) -> None:
    if graph.nodes[fault.part].exit_code is not None:
        return
    if fault.part == "device_driver":
        monitor.watch.observe_driver(monitor.now, responsive=False)
    if fault.kind is Kind.OFF:
        graph.kill(fault.part)
    else:
        graph.signal(fault.part, signal.SIGSTOP)


def _end(monitor: ProcessMonitor, graph: TrialProcesses, fault: Fault) -> None:
    if graph.nodes[fault.part].exit_code is not None:
        graph.begin(fault.part)
    else:
        graph.signal(fault.part, signal.SIGCONT)
    if fault.part == "device_driver":
        monitor.watch.observe_driver(monitor.now, responsive=True)
