"""One run of the virtual rig under a schedule of faults, watched from beginning to end."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Joy

from needle_core.ros.conversions import values_of
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_verification.ros.soak.fault_orders import LATEST_MESSAGE, FaultOrders
from needle_verification.ros.soak.moment_watch import watch_moments
from needle_verification.ros.soak.virtual_bench import Motors
from needle_verification.ros.soak.virtual_endpoint import Sample
from needle_verification.ros.soak.virtual_person import OUT, Wish
from needle_verification.ros.soak.virtual_rig import (
    SECOND_JOYSTICK,
    SECOND_OPERATOR,
    VirtualRig,
    virtual_rig,
)
from needle_verification.soak.course import Course, told_by_moments
from needle_verification.soak.faults import (
    CONSOLE,
    DISK,
    PAGE,
    PAGE_LINE,
    RECORDER,
    SECOND_PERSON,
    Fault,
    Kind,
    draw_schedule,
    strange_topic,
)
from needle_verification.soak.judging.invariants import RELEASE_BOUND, Violation, Watch
from needle_verification.soak.judging.limit_witness import Bounds
from needle_verification.soak.judging.set_point_frames import SetPointFrames
from needle_verification.soak.virtual_world import NANOSECONDS, STEADY_START_NS

# So long moments are waited for whose faults shall follow them [s].
_FAULTS_OVER = 30.0
# Once all faults are over [s]: a person has so long to insert, then so long to draw the needle
# out. A killed node counts for 8 s more, and a driver looks for its drives again.
_GO_ON, _DRAW_OUT = 60.0, 60.0
# A needle that nothing disturbs goes as deep [m], and is as near to the plane there [m].
UNDISTURBED_DEPTH, _CONVERGED = 0.08, 0.001
_HOLD, _JOINTS = "/device/hold", "/joint_states"
# The way of a press to the driver.
_HOLD_LINKS = ("/joy", _HOLD)
# Those who are there only where one of them goes wrong.
_AT_PAGE = (CONSOLE, PAGE, PAGE_LINE)
_RECORDED = (RECORDER, DISK)
_LATE = (Kind.SLOW, Kind.REORDERED, Kind.DUPLICATED)
# The device's faults that take the joints from the controller.
_TAKE_JOINTS = (_JOINTS, "device_driver", "plane_controller")


@dataclasses.dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes
    ----------
    seed : int
        Its seed.
    faults : tuple of Fault
        What happened to it.
    violations : tuple of Violation
        Invariants that did not hold.
    told_by_moments : tuple of Fault
        Those faults that happened, each told by the last moment that it met; of real processes as
        they were drawn.
    simulated : float
        How long it took in its own time [s].
    of_processes : bool
        Whether it was one of real processes: it cannot be had again, and has nothing of what
        follows.
    digest : str
        Of all that was published and called, of every command and of the motors' ways.
    inserted : bool
        Whether the controller was done once.
    log : tuple of str
        What the nodes logged, one line each.
    """

    seed: int
    faults: tuple[Fault, ...]
    violations: tuple[Violation, ...]
    told_by_moments: tuple[Fault, ...]
    simulated: float
    of_processes: bool = False
    digest: str = ""
    inserted: bool = False
    log: tuple[str, ...] = ()


def schedule_of(seed: int) -> list[Fault]:
    """Return the faults of a seed; every hundredth run has none."""
    return draw_schedule(seed) if seed % 100 else []


def bounds_of_the_rig() -> Bounds:
    """Return the limits that the driver has unless it is told others."""
    limits = SafetyLimits()
    return Bounds(
        limits.max_depth,
        limits.max_speed,
        limits.max_rotation,
        limits.max_rotation_rate,
        limits.insertion_following_error,
        limits.rotation_following_error,
    )


def run(seed: int, faults: Sequence[Fault]) -> RunResult:
    """Run the rig once.

    Parameters
    ----------
    seed : int
        Of the run: order, delays, needle, noise.
    faults : sequence of Fault
        What goes wrong meanwhile.
    """
    with virtual_rig(seed, None if faults else UNDISTURBED_DEPTH) as rig:
        if any(fault.part == SECOND_PERSON for fault in faults):
            # Their hand must be seen neutral before it counts.
            rig.start(SECOND_JOYSTICK)
            rig.start(SECOND_OPERATOR)
        if any(fault.part in _AT_PAGE for fault in faults):
            rig.sit_at_page()
        if any(fault.part in _RECORDED for fault in faults):
            rig.record()
        watch = _watched(rig, faults)
        course = Course(rig.world, faults, FaultOrders(rig).begin)
        watch_moments(rig, course.meet)
        # What has not come when the needle is out again never comes.
        rig.world.run_until(
            _ns(_FAULTS_OVER),
            lambda: not course.is_under_way and (not course.waits or _has_left(rig)),
        )
        course.give_up()
        calm = _seconds(rig.world.steady_ns)
        rig.world.run_until(_ns(calm + _GO_ON), lambda: _has_left(rig))
        if not _has_left(rig):
            rig.person.wish = Wish.DRAW_OUT
            rig.world.run_until(_ns(calm + _GO_ON + _DRAW_OUT), lambda: _has_left(rig))
        now = _seconds(rig.world.steady_ns)
        if not _has_left(rig):
            watch.violate("the_way_goes_on", now, _state_of(rig))
        for name, error in rig.world.crashes:
            watch.violate("no_node_crashes", now, f"{name}: {error}")
        if rig.recorders is not None:
            of_bags = [fault for fault in faults if fault.part in _RECORDED]
            losses = rig.recorders.end(judges_killed=len(of_bags) == 1)
            if losses:
                watch.violate("nothing_recorded_is_lost", now, "; ".join(losses))
        if not faults and not (rig.person.done and abs(rig.bench.deepest_tip[0]) <= _CONVERGED):
            off = f"the tip went to {rig.bench.deepest_tip[0] * 1e3:.2f} mm from the plane"
            watch.violate("undisturbed_converges", now, f"{off}; {_state_of(rig)}")
        return RunResult(
            seed,
            tuple(faults),
            tuple(watch.violations),
            tuple(told_by_moments(course)),
            now,
            digest=rig.graph.digest.hexdigest(),
            inserted=rig.person.done,
            log=tuple(
                f"{_seconds(at):9.3f} {name}: {level}: {text}" for at, name, level, text in rig.log
            ),
        )


def _watched(rig: VirtualRig, faults: Sequence[Fault]) -> Watch:
    """Return what watches over a rig from now on."""
    # A hold counts from its arrival: what is late on its way outlives the hand by as much.
    late = sum(
        fault.size * LATEST_MESSAGE
        for fault in faults
        if fault.part in _HOLD_LINKS and fault.kind in _LATE
    )
    # A page may be silent for 0.25 s, a joystick for 0.1 s.
    late += 0.15 if rig.page is not None else 0.0
    watch = Watch(bounds_of_the_rig(), RELEASE_BOUND + late)
    strange = {strange_topic(fault) for fault in faults}
    joints_spoilt = _JOINTS in strange or any(fault.part in _TAKE_JOINTS for fault in faults)

    def now() -> float:
        return _seconds(rig.world.steady_ns)

    def see_motors(at: Motors) -> None:
        at_s = now()
        process = rig.processes.get("device_driver")
        speaks = process is not None and process.alive and not process.stands_still
        rig.graph.digest.update(_rounded((at.insertion, at.rotation)))
        watch.see_hand(at_s, holds=rig.hand_presses)
        watch.see_driver(at_s, speaks=speaks)
        watch.see_motors(at_s, at.insertion, at.rotation)
        if rig.recorders is not None:
            watch.see_waiting(at_s, rig.recorders.bytes_waiting)

    def see_device(_: str, message: Any) -> None:
        watch.see_device(now(), values_of(message))

    def see_belief(_: str, message: Any) -> None:
        watch.see_belief(now(), values_of(message), joints_heard=not joints_spoilt)

    def see_command(_: str, message: Any) -> None:
        for point in message.points:
            rig.graph.digest.update(_rounded(point.positions))
        watch.see_command([(at.positions[0], at.positions[1]) for at in message.points])

    def see_estop(_: str, message: Any) -> None:
        watch.see_estop(now(), pressed=message.data)

    def see_hold(node: str, message: Any) -> None:
        pressed = any(message.buttons)
        if node == f"/{CONSOLE}":
            # It may have been pressed since the last tick.
            watch.see_hand(now(), holds=rig.hand_presses)
            watch.see_page_hold(now(), pressed=pressed)
        if pressed:
            (watch.see_hold if node == rig.hand_node else watch.see_other_hold)(now())

    def hear(topic: str, sample: Sample) -> None:
        if topic != _HOLD:
            return
        message = deserialize_message(sample.data, Joy)
        speed, lifetime = (*message.axes, math.inf)[:2]
        pressed = bool(message.buttons[0]) and 0.0 <= speed <= 1.0
        watch.witness.hear(now(), message.header.frame_id, pressed=pressed, lifetime=lifetime)

    rig.bench.watchers.append(see_motors)
    _watch_set_points(rig, watch)
    rig.graph.watch("/device/status", see_device)
    rig.graph.watch("/needle/controller_status", see_belief)
    rig.graph.watch("/device/joint_trajectory", see_command)
    rig.graph.watch("/device/estop", see_estop)
    rig.graph.watch(_HOLD, see_hold)
    if _HOLD in strange or any(fault.part == SECOND_PERSON for fault in faults):
        rig.graph.listen_at("/device_driver", hear)
    return watch


def _watch_set_points(rig: VirtualRig, watch: Watch) -> None:
    """Let the watch see all set-points that the driver sends."""
    settings = [rig.bench.bus.drives[axis].settings for axis in ("insertion", "rotation")]
    axes = {its.node_id: axis for axis, its in enumerate(settings)}
    frames = SetPointFrames({its.node_id: its.motor.counts_per_unit for its in settings})

    def see(identifier: int, data: bytes) -> None:
        if (set_point := frames.take(identifier, data)) is not None:
            node, place = set_point
            watch.see_set_point(_seconds(rig.world.steady_ns), axes[node], place)

    rig.can.sent_watchers.append(see)


def _rounded(place: Sequence[float]) -> bytes:
    """Return a place for the digest, to 1 nm and 1 nrad: Pythons' numpy differ in last bits."""
    return " ".join(f"{value:.9f}" for value in place).encode() + b"\n"


def _has_left(rig: VirtualRig) -> bool:
    return rig.person.wish is Wish.LEAVE and rig.bench.motors.insertion < OUT


def _state_of(rig: VirtualRig) -> str:
    device, controller = rig.person.device, rig.person.controller
    return (
        f"the needle is {rig.bench.motors.insertion * 1e3:.2f} mm in; device "
        f"{device.get('state')}: {device.get('fault') or device.get('reason')}; controller "
        f"{controller.get('state')}: {controller.get('reason')}"
    )


def _ns(seconds: float) -> int:
    return STEADY_START_NS + round(seconds * NANOSECONDS)


def _seconds(steady_ns: int) -> float:
    return (steady_ns - STEADY_START_NS) / NANOSECONDS
