"""Effects of each fault of the vocabulary on the virtual rig, at its begin and at its end."""

from __future__ import annotations

import errno
import math
import random
from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState, Joy
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from needle_core.ros.conversions import HOLD, LATCHED, RELIABLE, to_stamp
from needle_verification.ros.soak.virtual_bench import Sight
from needle_verification.ros.soak.virtual_can import LINKS
from needle_verification.ros.soak.virtual_node import Place, VirtualNode, placed
from needle_verification.ros.soak.virtual_rig import SECOND_JOYSTICK, SECOND_OPERATOR, VirtualRig
from needle_verification.soak import faults
from needle_verification.soak.course import Undo
from needle_verification.soak.faults import Fault, Kind
from needle_verification.soak.link_faults import LinkFault
from needle_verification.soak.virtual_disk import ROOM
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess

_LINKS = (*faults.TOPICS, *faults.SERVICES, faults.BUS, faults.PAGE_LINE)
_SLOWEST_CALLBACK_NS, _SLOWEST_JOB_NS = 50_000_000, 5_000_000
LATEST_MESSAGE = 1.0
"""What the worst of faults delays a message by [s]."""
_LATEST_NS = round(LATEST_MESSAGE * NANOSECONDS)
_LATEST_FRAME_NS = 100_000_000
_STRANGER_RATE, _FLOOD_RATE = 20.0, 5000.0
_JUMP_NS = 20 * NANOSECONDS
_DRIFT_NS, _DRIFT_PERIOD_NS = 2_000_000, 20_000_000
# Seconds between two changes of mind of a hand that trembles.
_TREMBLING = (0.03, 0.3)
_WAVERING = ((True, False), (False, False), (False, True), (True, True))
_MOTION_ERROR = 0x5530
_SIGHTS = {
    Kind.OFF: Sight.BLACK,
    Kind.STUCK: Sight.FROZEN,
    Kind.WRONG: Sight.WRONG,
    Kind.SLOW: Sight.LATE,
    Kind.GARBAGE: Sight.WRONG,
}


def _nothing() -> None:
    """Do nothing: the fault was over at once."""


class FaultOrders:
    """Lets faults begin and end.

    Parameters
    ----------
    rig : VirtualRig
        What they happen to.
    """

    def __init__(self, rig: VirtualRig) -> None:
        self._rig = rig
        self._world = rig.world
        self._stranger: VirtualNode | None = None
        self._spoilers: dict[str, Callable[[Fault], Undo]] = {
            **dict.fromkeys(
                (*faults.PROCESSES, faults.CONSOLE, faults.RECORDER), self._spoil_process
            ),
            **dict.fromkeys(_LINKS, self._spoil_links),
            faults.PAGE: self._spoil_page,
            faults.DISK: self._spoil_disk,
            **dict.fromkeys(faults.DRIVES, self._spoil_drive),
            faults.ADAPTER: self._unplug,
            faults.CAMERAS: self._spoil_cameras,
            faults.CLOCK: self._spoil_clock,
            faults.PERSON: self._confuse_person,
            faults.SECOND_PERSON: self._let_second_person_in,
            faults.PARAMETERS: self._change_parameters,
        }

    def begin(self, fault: Fault) -> Undo:
        """Let a fault begin; returns what ends it."""
        return self._spoilers.get(fault.part, self._let_stranger_act)(fault)

    def _chance_of(self, fault: Fault) -> random.Random:
        return self._world.chance("fault", fault.part)

    # ---- parts --------------------------------------------------------------------------------

    def _spoil_process(self, fault: Fault) -> Undo:
        rig, name = self._rig, fault.part
        if fault.kind is Kind.OFF:
            rig.kill(name)
            return partial(rig.start, name)
        process = rig.processes.get(name)
        if process is None:
            return _nothing
        if fault.kind is Kind.STUCK:
            process.stop()
            return process.resume
        process.slowness_ns = round(fault.size * _SLOWEST_CALLBACK_NS)
        return partial(setattr, process, "slowness_ns", 0)

    def _unplug(self, _: Fault) -> Undo:
        self._rig.can.unplug()
        return partial(setattr, self._rig.can, "unplugged", False)

    def _spoil_links(self, fault: Fault) -> Undo:
        is_bus = fault.part == faults.BUS
        names = LINKS if is_bus else (fault.part,)
        late_ns = round(fault.size * (_LATEST_FRAME_NS if is_bus else _LATEST_NS))
        spoilt = {
            Kind.OFF: LinkFault(loss=1.0),
            Kind.INTERMITTENT: LinkFault(loss=fault.size),
            Kind.SLOW: LinkFault(late_ns=late_ns),
            Kind.REORDERED: LinkFault(late_ns=late_ns, reorders=True),
            Kind.DUPLICATED: LinkFault(late_ns=late_ns, duplicates=0.5, reorders=True),
        }[fault.kind]
        for name in names:
            self._rig.faults.begin(name, spoilt)

        def end() -> None:
            for name in names:
                self._rig.faults.end(name)

        return end

    def _spoil_drive(self, fault: Fault) -> Undo:
        axis, kind = fault.part.partition(" ")[0], fault.kind
        bus, now = self._rig.bench.bus, self._world.steady
        drive = bus.drives[axis]
        if kind is Kind.OFF:
            bus.reboot(axis, now)
            return _nothing
        if kind is Kind.GARBAGE:
            bus.emergency(axis, _MOTION_ERROR)
            return _nothing
        if kind is Kind.STUCK:
            bus.stall(axis)
            return partial(setattr, drive.motor, "stalled", False)
        bus.hang(axis)

        def go_on() -> None:
            drive.hung = False
            drive.tick(self._world.steady)

        return go_on

    def _spoil_cameras(self, fault: Fault) -> Undo:
        def see(sight: Sight) -> None:
            if self._rig.tracker is not None:
                self._rig.tracker.sight = sight

        see(_SIGHTS[fault.kind])
        return partial(see, Sight.CLEAR)

    def _spoil_clock(self, fault: Fault) -> Undo:
        world = self._world
        if fault.kind is Kind.WRONG:
            jump_ns = round((fault.size - 0.5) * 2.0 * _JUMP_NS)
            world.system_offset_ns += jump_ns
            return partial(setattr, world, "system_offset_ns", world.system_offset_ns - jump_ns)
        end_ns = world.steady_ns + round(fault.lasts * NANOSECONDS)

        def drift() -> None:
            if world.steady_ns < end_ns:
                world.system_offset_ns -= round(fault.size * _DRIFT_NS)
                world.call_after(_DRIFT_PERIOD_NS, drift)

        drift()
        return _nothing

    def _confuse_person(self, fault: Fault) -> Undo:
        rig, world = self._rig, self._world
        person, hand = rig.person, rig.hand
        person.absent = True
        end_ns = world.steady_ns + round(fault.lasts * NANOSECONDS)

        chance = self._chance_of(fault)

        def tremble() -> None:
            if world.steady_ns < end_ns:
                hand.insert = not hand.insert
                world.call_after(round(chance.uniform(*_TREMBLING) * NANOSECONDS), tremble)

        if fault.kind is Kind.OFF:
            hand.insert = hand.retract = hand.stop = False
        elif fault.kind is Kind.INTERMITTENT:
            tremble()
        elif fault.kind is Kind.WRONG:
            hand.insert, hand.retract = fault.size < 0.6, fault.size > 0.4
            hand.stop = fault.size > 0.9

        def end() -> None:
            person.absent = hand.stop = False

        return end

    def _spoil_page(self, fault: Fault) -> Undo:
        page = self._rig.page
        assert page is not None, "who sits at no page spoils none"
        if fault.kind is Kind.OFF:
            page.close()
            return page.open
        if fault.kind is Kind.STUCK:
            page.freeze()
            return page.go_on
        doing = "sends_garbage" if fault.kind is Kind.GARBAGE else "repeats"
        setattr(page, doing, True)
        return partial(setattr, page, doing, False)

    def _spoil_disk(self, fault: Fault) -> Undo:
        recorders = self._rig.recorders
        assert recorders is not None, "who records nothing has no disk"
        disk = recorders.disk
        if fault.kind is Kind.STUCK:
            disk.stands_still = True
            return partial(setattr, disk, "stands_still", False)
        if fault.kind is Kind.SLOW:
            disk.slowness_ns = round(fault.size * _SLOWEST_JOB_NS)
            return partial(setattr, disk, "slowness_ns", 0)
        if fault.kind is Kind.GARBAGE:
            disk.error = errno.EIO
        elif fault.size < 0.5:
            # Others fill it, and it can be seen.
            disk.room = 0
        else:
            disk.error = errno.ENOSPC

        def mend() -> None:
            disk.error, disk.room = 0, ROOM

        return mend

    def _let_second_person_in(self, fault: Fault) -> Undo:
        rig, hand = self._rig, self._rig.second_hand
        chance, world = self._chance_of(fault), self._world
        end_ns = world.steady_ns + round(fault.lasts * NANOSECONDS)

        def let_go() -> None:
            hand.insert = hand.retract = False

        def waver() -> None:
            if world.steady_ns < end_ns:
                hand.insert, hand.retract = chance.choice(_WAVERING)
                world.call_after(round(chance.uniform(*_TREMBLING) * NANOSECONDS), waver)

        if fault.kind is Kind.INTERMITTENT:
            waver()
            return let_go
        hand.insert, hand.retract = fault.kind is not Kind.WRONG, fault.kind is Kind.WRONG
        if fault.kind is not Kind.OFF:
            return let_go

        def lose() -> None:
            rig.kill(SECOND_JOYSTICK if fault.size < 0.5 else SECOND_OPERATOR)

        return lose

    def _change_parameters(self, fault: Fault) -> Undo:
        node = self._rig.nodes.get("plane_controller")
        if node is None:
            return _nothing
        wrong = {
            "curvature": 4.0 + 10.0 * fault.size,
            "step_length": 5e-4 + 2e-3 * fault.size,
            "nominal_speed": 1e-3 + 1e-2 * fault.size,
            "depth": 0.03 * fault.size,
        }
        garbage = {"curvature": math.nan, "step_length": -1.0, "curvatur": 1.0, "depth": "deep"}
        choice = wrong if fault.kind is Kind.WRONG else garbage
        name = self._chance_of(fault).choice(tuple(choice))
        process = self._rig.processes["plane_controller"]
        had = node.get_parameter(name).value if node.has_parameter(name) else None

        def change_to(value: Any) -> None:
            change = partial(node.set_parameters, [Parameter(name, value=value)])
            process.do(lambda: node.run_guarded("set_parameters", change))

        change_to(choice[name])
        # A name that it does not know was not taken.
        return partial(change_to, had) if had is not None else _nothing

    # ---- strangers ----------------------------------------------------------------------------

    def _let_stranger_act(self, fault: Fault) -> Undo:
        topic = faults.strange_topic(fault)
        stranger = self._make_stranger()
        if not topic:
            name = fault.part.removeprefix(faults.STRANGER)
            client_of = self._rig.person
            if name.endswith(" off"):
                client_of.call("enable", on=False)
            elif name in ("/device/enable", "/device/confirm_needle_out"):
                client_of.call(name.rpartition("/")[2], on=True)
            else:
                client_of.call(name.removeprefix("/"))
            return _nothing
        make, kind, qos = self._strange_messages(fault)
        publisher = stranger.create_publisher(kind, topic, qos)
        rate = _FLOOD_RATE if fault.part == faults.FLOOD else _STRANGER_RATE
        end_ns = self._world.steady_ns + round(fault.lasts * NANOSECONDS)

        def act() -> None:
            if self._world.steady_ns < end_ns:
                publisher.publish(make())
                self._world.call_after(round(NANOSECONDS / rate), act)

        def end() -> None:
            if kind is Bool:
                publisher.publish(Bool(data=False))
            publisher.gone_ns = self._world.steady_ns

        act()
        return end

    def _make_stranger(self) -> VirtualNode:
        if self._stranger is None:
            process = VirtualProcess(self._world, "stranger", lambda _: None)
            place = Place(self._rig.graph, process, 0, {}, lambda *_: None)
            with placed(place):
                self._stranger = VirtualNode("stranger")
        return self._stranger

    def _strange_messages(self, fault: Fault) -> tuple[Callable[[], Any], type[Any], Any]:
        """Return what makes the next message, its class and QoS."""
        chance, bench = self._chance_of(fault), self._rig.bench
        draw = chance.uniform

        def number(value: float) -> float:
            if fault.kind is Kind.GARBAGE:
                return chance.choice((math.nan, math.inf, -1e300))
            return value

        def stamp() -> Any:
            return to_stamp(self._world.system_ns)

        def hold() -> Joy:
            message = Joy(axes=[number(1.0), 0.1], buttons=[1])
            message.header.stamp, message.header.frame_id = stamp(), "stranger"
            return message

        def trajectory() -> JointTrajectory:
            at = bench.motors
            point = JointTrajectoryPoint(positions=[number(at.insertion + 0.001), at.rotation])
            point.time_from_start.nanosec = 500_000_000
            message = JointTrajectory(
                joint_names=["insertion_joint", "rotation_joint"], points=[point]
            )
            message.header.stamp = stamp()
            return message

        def joints() -> JointState:
            message = JointState(name=["insertion_joint", "rotation_joint"])
            message.position = [number(draw(0.0, 0.1)), draw(-1.0, 1.0)]
            message.header.stamp = stamp()
            return message

        def tip() -> PointStamped:
            message = PointStamped()
            message.header.stamp, message.header.frame_id = stamp(), "rig"
            message.point.x = number(draw(-0.003, 0.003))
            message.point.z = bench.motors.insertion
            return message

        def plane() -> PoseStamped:
            message = PoseStamped()
            message.header.stamp, message.header.frame_id = stamp(), "rig"
            message.pose.position.x = number(draw(-0.002, 0.002))
            return message

        rows: dict[str, tuple[Callable[[], Any], type[Any], Any]] = {
            "/device/hold": (hold, Joy, HOLD),
            "/device/joint_trajectory": (trajectory, JointTrajectory, RELIABLE),
            "/device/estop": (lambda: Bool(data=True), Bool, RELIABLE),
            "/joint_states": (joints, JointState, RELIABLE),
            "/needle/tip": (tip, PointStamped, RELIABLE),
            "/target_plane": (plane, PoseStamped, LATCHED),
        }
        return rows[faults.strange_topic(fault)]
