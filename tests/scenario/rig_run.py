"""One run of the rig under a schedule of faults, with its invariants checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from needle_core import messages as m
from needle_device_driver.supervisor.limits import SafetyLimits
from scenario import faults as of
from scenario.fault_injector import LATEST_MESSAGE, SLOWEST_HANDLER, FaultInjector
from scenario.faults import Fault, Kind, draw_schedule, rogue_topic
from scenario.monitors.invariants import RELEASE_BOUND, InvariantMonitor, Violation
from scenario.monitors.limit_monitor import SetPointFrames
from scenario.parts.bench import Motors
from scenario.parts.operator_model import OUT, OperatorGoal
from scenario.rig import SECOND, SoakRig
from scenario.schedule_runner import ScheduleRunner, relative_to_moments, watch_moments

# Longest wait for moments that faults follow [s].
_FAULTS_OVER = 30.0
# Time to insert after all faults, then to withdraw the needle [s]: a killed node stays in the graph
# for 8 s, and a restarted driver sets its drives up again.
_GO_ON, _DRAW_OUT = 60.0, 60.0
# Period of the check whether a run is over [s].
_POLL_PERIOD = 0.1
# Depth of a run without faults [m], and largest distance of its tip from the plane [m].
UNDISTURBED_DEPTH, _CONVERGED = 0.08, 0.001
_HOLD, _JOINTS = "/device/hold", "/joint_states"
# Topics between a press and the driver.
_HOLD_LINKS = ("/joy", _HOLD)
# With a fault of one of these, the operator holds by a page.
_AT_PAGE = (of.CONSOLE, of.PAGE, of.PAGE_LINE)
_LATE = (Kind.SLOW, Kind.REORDERED, Kind.DUPLICATED)
# Parts whose faults keep joint states from the controller.
_JOINT_STATE_SOURCES = (_JOINTS, "device_driver", "plane_controller")


@dataclasses.dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes
    ----------
    seed : int
        Seed of the run.
    faults : tuple of Fault
        Faults of the run.
    violations : tuple of Violation
        Violated invariants.
    relative_to_moments : tuple of Fault
        Faults that began, relative to the last moment before each; as drawn for real processes.
    simulated : float
        Duration in simulated time [s].
    of_processes : bool
        Whether it was a run of real processes, which is not repeatable and has none of the
        following.
    digest : str
        Digest of all publications, commands and motor positions.
    inserted : bool
        Whether the controller was in state DONE once.
    log : tuple of str
        Log lines of the nodes.
    """

    seed: int
    faults: tuple[Fault, ...]
    violations: tuple[Violation, ...]
    relative_to_moments: tuple[Fault, ...]
    simulated: float
    of_processes: bool = False
    digest: str = ""
    inserted: bool = False
    log: tuple[str, ...] = ()


def schedule_of(seed: int) -> list[Fault]:
    """Return the faults of a seed; every hundredth seed has none."""
    return draw_schedule(seed) if seed % 100 else []


def run(seed: int, faults: Sequence[Fault]) -> RunResult:
    """Run the rig once.

    Parameters
    ----------
    seed : int
        Seed of delays, needle and noise.
    faults : sequence of Fault
        Faults of the run.
    """
    at_page = any(fault.part in _AT_PAGE for fault in faults)
    rig = SoakRig(seed, None if faults else UNDISTURBED_DEPTH, at_page=at_page)
    if any(fault.part == of.SECOND_PERSON for fault in faults):
        # Their joystick must report neutral once before it counts.
        for name in SECOND:
            rig.start(name)
    of_recording = [fault for fault in faults if fault.part in (of.RECORDER, of.DISK)]
    if of_recording:
        rig.record()
    watch = _watched(rig, faults)
    schedule = ScheduleRunner(rig.runner.timeline, faults, FaultInjector(rig).begin)
    watch_moments(rig, schedule.reach)
    # Moments that were not reached when the needle is out again are never reached.
    while rig.now < _FAULTS_OVER and (
        schedule.has_active or (schedule.has_pending and not _has_left(rig))
    ):
        rig.run(_POLL_PERIOD)
    schedule.cancel_pending()
    calm = rig.now
    while rig.now < calm + _GO_ON + _DRAW_OUT and not _has_left(rig):
        if rig.now > calm + _GO_ON and rig.person.goal is OperatorGoal.INSERT:
            rig.person.goal = OperatorGoal.WITHDRAW
        rig.run(_POLL_PERIOD)
    if not _has_left(rig):
        watch.violate("run_can_continue", rig.now, _state_of(rig))
    losses = rig.losses(check_killed=len(of_recording) == 1)
    if losses:
        watch.violate("nothing_recorded_is_lost", rig.now, "; ".join(losses))
    for error in rig.crashes:
        watch.violate("no_node_crashes", rig.now, error)
    if not faults and not (rig.person.done and abs(rig.bench.deepest_tip[0]) <= _CONVERGED):
        off = f"the tip went to {rig.bench.deepest_tip[0] * 1e3:.2f} mm from the plane"
        watch.violate("undisturbed_converges", rig.now, f"{off}; {_state_of(rig)}")
    return RunResult(
        seed, tuple(faults), tuple(watch.violations), tuple(relative_to_moments(schedule)), rig.now,
        digest=rig.digest.hexdigest(), inserted=rig.person.done, log=tuple(rig.log),
    )  # fmt: skip


def _watched(rig: SoakRig, faults: Sequence[Fault]) -> InvariantMonitor:
    """Return a monitor that observes a rig from now on."""
    # A hold counts from its arrival: a late message outlives the press by its delay.
    late = sum(
        fault.size * LATEST_MESSAGE
        for fault in faults
        if fault.part in _HOLD_LINKS and fault.kind in _LATE
    )
    # A page may be silent for 0.25 s, a joystick for 0.1 s.
    late += 0.15 if rig.hand_node == of.CONSOLE else 0.0
    slow = (f.size for f in faults if f.part == "device_driver" and f.kind is Kind.SLOW)
    slowness = max(slow, default=0.0) * SLOWEST_HANDLER
    watch = InvariantMonitor(SafetyLimits(), RELEASE_BOUND + late, slowness)
    rogue = {rogue_topic(fault) for fault in faults}
    joints_faulty = _JOINTS in rogue or any(fault.part in _JOINT_STATE_SOURCES for fault in faults)

    def observe_motors(now: float, at: Motors) -> None:
        rig.digest.update(_rounded((at.insertion, at.rotation)))
        watch.observe_hand(now, holds=rig.hand_presses)
        watch.observe_driver(now, responsive=rig.runner.is_responsive("device_driver"))
        watch.observe_motors(now, at.insertion, at.rotation)
        if rig.recorders:
            watch.observe_waiting(now, rig.recorders[-1].recording.bytes_waiting)

    def observe_command(_: str, message: m.Trajectory) -> None:
        for point in message.points:
            rig.digest.update(_rounded(point.positions))
        watch.observe_command([(at.positions[0], at.positions[1]) for at in message.points])

    def observe_hold(node: str, message: m.HoldState) -> None:
        if node == of.CONSOLE:
            # The hand may have been pressed since the last tick.
            watch.observe_hand(rig.now, holds=rig.hand_presses)
            watch.observe_page_hold(rig.now, pressed=message.pressed)
        if message.pressed:
            (watch.observe_hold if node == rig.hand_node else watch.observe_other_hold)(rig.now)

    def receive(message: m.HoldState, now: float) -> None:
        pressed = message.pressed and 0.0 <= message.speed_scale <= 1.0
        watch.hold_monitor.receive(now, message.source, pressed=pressed, lifetime=message.lifetime)

    rig.bench.watchers.append(observe_motors)
    _watch_set_points(rig, watch)
    rig.watch("device/status", lambda _, message: watch.observe_device(rig.now, message))
    rig.watch(
        "needle/controller_status",
        lambda _, message: watch.observe_belief(rig.now, message, joints_known=not joints_faulty),
    )
    rig.watch("device/joint_trajectory", observe_command)
    rig.watch("device/estop", lambda _, estop: watch.observe_estop(rig.now, pressed=estop.pressed))
    rig.watch("device/hold", observe_hold)
    if _HOLD in rogue or any(fault.part == of.SECOND_PERSON for fault in faults):
        rig.on_hold_received = receive
    return watch


def _watch_set_points(rig: SoakRig, watch: InvariantMonitor) -> None:
    """Pass all set-points that the driver sends to the monitor."""
    settings = [rig.drives.bus.drives[axis].settings for axis in ("insertion", "rotation")]
    axes = {its.node_id: axis for axis, its in enumerate(settings)}
    frames = SetPointFrames({its.node_id: its.motor.counts_per_unit for its in settings})

    def watch_frames(batch: Sequence[Any]) -> None:
        for frame in batch:
            if (set_point := frames.decode_set_point(frame.identifier, frame.data)) is not None:
                node, position = set_point
                watch.observe_set_point(rig.now, axes[node], position)

    rig.frames_sent.append(watch_frames)


def _rounded(position: Sequence[float]) -> bytes:
    """Return a position for the digest, to 1 nm and 1 nrad: numpy versions differ in last bits."""
    return " ".join(f"{value:.9f}" for value in position).encode() + b"\n"


def _has_left(rig: SoakRig) -> bool:
    return rig.person.goal is OperatorGoal.LEAVE and rig.bench.motors.insertion < OUT


def _state_of(rig: SoakRig) -> str:
    device, controller = rig.person.device, rig.person.controller
    return (
        f"the needle is {rig.bench.motors.insertion * 1e3:.2f} mm in; device "
        f"{device.state}: {device.why}; controller {controller.state}: {controller.reason}"
    )
