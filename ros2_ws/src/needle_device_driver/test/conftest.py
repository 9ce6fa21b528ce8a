"""A supervisor on two ideal axes, and on two scripted drives behind a CAN bus."""

from __future__ import annotations

import contextlib
import itertools
import queue
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest

from needle_device_driver.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.can_link import CanLink, LinkError
from needle_device_driver.cia402_axis import Cia402Axis
from needle_device_driver.command import Command, CommandPoint
from needle_device_driver.drive_cycle import DriveCycle
from needle_device_driver.hold import HoldMessage
from needle_device_driver.limits import SafetyLimits
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.reports import DeviceStatus, Event, Notice, StepResult
from needle_device_driver.rules import Rule
from needle_device_driver.states import State
from needle_device_driver.supervisor import MotionSupervisor

PERIOD = 0.02


class FakeAxis(Axis):
    """Goes where it is told; fails, lags or falls silent when told to."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.position = 0.0
        self.target: float | None = None
        self.speed = 0.0
        self.powered = False
        self.homed = False
        self.homing = False
        self.switch: bool | None = None
        self.fault = ""
        self.unplugged = False
        self.silent_since: float | None = None
        self.stuck = False
        self.stops = 0
        self.orders: list[str] = []

    def _order(self, name: str) -> None:
        if self.unplugged:
            raise AxisError(f"{self.name}: no link")
        self.orders.append(name)

    def configure(self) -> None:
        self._order("configure")

    def power(self, on: bool) -> None:
        self._order("on" if on else "off")
        self.powered, self.target, self.homing = on, None, False

    def home(self, speed: float) -> None:
        self._order("home")
        self.homed = self.position == 0.0
        self.homing, self.target, self.speed = not self.homed, 0.0, speed

    def start_move(self, target: float, speed: float) -> None:
        self._order("move")
        self.target, self.speed = target, speed

    def stop(self) -> None:
        self._order("stop")
        self.stops += 1
        self.target, self.homing = None, False

    def reset(self) -> None:
        self._order("reset")
        self.fault = ""

    def close(self) -> None:
        self.powered = False

    def poll(self, now: float) -> AxisSnapshot:
        switch = self.position <= 0.0 if self.switch is None else self.switch
        return AxisSnapshot(
            time=now if self.silent_since is None else self.silent_since,
            position=self.position,
            velocity=0.0,
            powered=self.powered,
            homed=self.homed,
            moving=self.homing,
            at_home_switch=switch,
            fault=self.fault,
        )

    def advance(self, period: float) -> None:
        if self.target is None or not self.powered or self.stuck:
            return
        way = self.target - self.position
        reach = self.speed * period
        if abs(way) <= reach * (1 + 1e-9):
            self.position = self.target
            self.homed = self.homed or self.homing
            self.homing = False
        else:
            self.position += reach if way > 0 else -reach


class Bench:
    """Drives a supervisor cycle by cycle and remembers what it tells."""

    period = PERIOD

    def __init__(self, *, pause_on_lapse: bool = False, **limits: float) -> None:
        self.insertion = FakeAxis("insertion")
        self.rotation = FakeAxis("rotation")
        self.limits = SafetyLimits(**limits)
        self.supervisor = MotionSupervisor(
            self.insertion, self.rotation, self.limits, pause_on_lapse=pause_on_lapse
        )
        self.now = 100.0
        self.ros_ns = 1_000_000_000
        self.stamps = itertools.count(1)
        self.events: list[Event] = []
        self.supervisor.note_time(0, self.now)
        self.supervisor.note_time(self.ros_ns, self.now)

    @property
    def state(self) -> State:
        return self.supervisor.state

    @property
    def status(self) -> DeviceStatus:
        return self.supervisor.status(self.now)

    @property
    def results(self) -> list[StepResult]:
        self._collect()
        return [event for event in self.events if isinstance(event, StepResult)]

    @property
    def last_rule(self) -> Rule | None:
        self._collect()
        notices = [event for event in self.events if isinstance(event, Notice)]
        return notices[-1].rule if notices else None

    @property
    def positions(self) -> tuple[float, float]:
        return self.insertion.position, self.rotation.position

    def _collect(self) -> None:
        self.events += self.supervisor.take_events()

    def hold(
        self,
        pressed: bool = True,
        *,
        sender: str = "a",
        scale: float = 1.0,
        stamp_ns: int | None = None,
    ) -> None:
        stamp = next(self.stamps) if stamp_ns is None else stamp_ns
        self.supervisor.receive_hold(HoldMessage(sender, stamp, pressed, scale), self.now)

    def cycle(self, count: int = 1, *, holding: bool = False, scale: float = 1.0) -> None:
        for _ in range(count):
            self.now += PERIOD
            self.ros_ns += 20_000_000
            if holding:
                self.hold(scale=scale)
            self.supervisor.note_time(self.ros_ns, self.now)
            self.supervisor.drive(PERIOD, self.now)
            self.insertion.advance(PERIOD)
            self.rotation.advance(PERIOD)
            self.supervisor.observe(self.now)

    def home(self) -> None:
        self.supervisor.configure(self.now)
        self.supervisor.confirm_needle_out(True)
        assert self.supervisor.home(self.now).success

    def ready(self, *, holding: bool = True) -> None:
        self.home()
        assert self.supervisor.enable(True, self.now).success
        if holding:
            self.hold()

    @staticmethod
    def step_command(
        insertion: float, rotation: float, stamp_ns: int, duration: float = 0.5
    ) -> Command:
        return Command(
            stamp_ns,
            ("insertion_joint", "rotation_joint"),
            (CommandPoint((insertion, rotation), (), duration),),
        )

    def command(
        self,
        length: float = 0.001,
        rotation: float = 0.1,
        *,
        duration: float = 0.5,
        publishers: int = 1,
        stamp_ns: int | None = None,
    ) -> int:
        stamp = self.ros_ns if stamp_ns is None else stamp_ns
        here = self.positions
        self.supervisor.submit(
            self.step_command(here[0] + length, here[1] + rotation, stamp, duration),
            self.now,
            publishers,
        )
        return stamp


@pytest.fixture(scope="session")
def make_bench() -> type[Bench]:
    return Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


# ---- drives ------------------------------------------------------------------------------------


class ScriptedDrive:
    """One CiA 402 drive as a script: what it answers to each frame, written from the standard.

    It moves ideally: at each SYNC it tells where it is, then it is at its set-point.
    """

    STATES = {
        "disabled": 0x0250,
        "ready": 0x0231,
        "on": 0x0233,
        "enabled": 0x0237,
        "quick stop": 0x0217,
        "fault": 0x0218,
    }

    def __init__(self, node: int) -> None:
        self.node = node
        self.objects: dict[tuple[int, int], bytes] = {
            (0x1000, 0): (402).to_bytes(4, "little"),
            (0x6502, 0): (0x000000A1).to_bytes(4, "little"),
            (0x603F, 0): b"\x00\x00",
        }
        self.lacking: set[int] = set()
        self.state = "disabled"
        self.mode = 0
        self.inputs = 0
        self.status_size = 7
        self.position = 0
        self.target = 0
        self.next_target = 0
        self.demand = 0
        self.more_status = 0
        self.nmt = 0x7F
        self.silent = False
        self.deaf_to_reset = False
        self.blocked = False
        self.keeps_quick_stop = False
        self.home_after = 3
        self.homing_for = -1
        self.last_word = 0
        self.stale_homing = False
        self.out: list[tuple[int, bytes]] = []

    def say(self, function: int, data: bytes) -> None:
        if not self.silent:
            self.out.append((function + self.node, data))

    def reboot(self) -> None:
        self.nmt, self.state, self.position, self.mode = 0x7F, "disabled", 0, 0
        self.say(0x700, b"\x00")

    def fail(self, code: int) -> None:
        self.state = "fault"
        self.objects[0x603F, 0] = code.to_bytes(2, "little")
        self.say(0x80, code.to_bytes(2, "little") + bytes(6))

    @property
    def statusword(self) -> int:
        return self.STATES[self.state] | self.more_status

    def take(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x600 + self.node:
            self.sdo(data)
        elif cob_id == 0 and data[1] == self.node:
            self.nmt = {0x01: 0x05, 0x80: 0x7F}[data[0]]
        elif cob_id == 0x77F:
            self.say(0x700, bytes([self.nmt]))
        elif self.nmt != 0x05:
            return
        elif cob_id == 0x200 + self.node:
            self.command(int.from_bytes(data[:2], "little"))
            self.mode = data[2]
        elif cob_id == 0x300 + self.node:
            self.next_target = int.from_bytes(data, "little", signed=True)
        elif cob_id == 0x80:
            self.sync()

    def sync(self) -> None:
        status = self.statusword.to_bytes(2, "little") + bytes([self.mode])
        status += self.inputs.to_bytes(4, "little")
        self.say(0x180, status[: self.status_size])
        self.say(0x280, self.position.to_bytes(4, "little", signed=True))
        self.target = self.next_target
        if self.homing_for >= 0:
            self.homing_for += 1
            if self.homing_for >= self.home_after:
                self.homing_for = -1
                self.position = 0
                self.more_status = 0x1400
        else:
            self.follow()

    def follow(self) -> None:
        """With power, also in a quick stop, the motor goes to the demand."""
        if self.state == "enabled" and self.mode == 8:
            self.demand = self.target
        elif self.state != "quick stop":
            self.demand = self.position
        if not self.blocked:
            self.position = self.demand

    def command(self, word: int) -> None:
        if self.state == "fault":
            if word & 0x80 and not self.deaf_to_reset:
                self.state = "disabled"
        elif not word & 0x02:
            self.state = "disabled"
        elif not word & 0x04:
            self.state = "quick stop" if self.state in ("enabled", "quick stop") else "disabled"
        elif word & 0x0F == 0x06 and self.state in ("disabled", "on", "enabled"):
            self.state = "ready"
        elif word & 0x0F == 0x07 and self.state in ("ready", "enabled"):
            self.state = "on"
        elif word & 0x0F == 0x0F and (
            self.state == "on" or (self.state == "quick stop" and not self.keeps_quick_stop)
        ):
            self.state = "enabled"
        rising = word & 0x10 and not self.last_word & 0x10
        self.last_word = word
        if rising and self.mode == 6 and self.state == "enabled":
            self.homing_for = 0
            if not self.stale_homing:
                self.more_status = 0
        if self.mode != 6:
            self.homing_for = -1
            self.more_status = 0x1400 if self.stale_homing else 0

    def sdo(self, data: bytes) -> None:
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        head = data[1:4]
        if data[0] == 0x80:
            return
        if index in self.lacking:
            self.say(0x580, b"\x80" + head + bytes.fromhex("00000206"))
        elif data[0] == 0x40:
            live = {
                (0x6041, 0): self.statusword.to_bytes(2, "little"),
                (0x6061, 0): bytes([self.mode]),
                (0x6064, 0): self.position.to_bytes(4, "little", signed=True),
                (0x60FD, 0): self.inputs.to_bytes(4, "little"),
            }
            value = live.get((index, sub)) or self.objects.get((index, sub))
            if value is None:
                self.say(0x580, b"\x80" + head + bytes.fromhex("00000206"))
                return
            first = 0x43 | (4 - len(value)) << 2
            self.say(0x580, bytes([first]) + head + value.ljust(4, b"\x00"))
        else:
            size = 4 - (data[0] >> 2 & 3)
            value = data[4 : 4 + size]
            self.objects[index, sub] = value
            if index == 0x6040:
                self.command(int.from_bytes(value, "little"))
            self.say(0x580, b"\x60" + head + bytes(4))


class ScriptedBus:
    """python-can's bus with two scripted drives behind it; remembers what was sent."""

    def __init__(self, drives: list[ScriptedDrive]) -> None:
        self.drives = drives
        self.sent: list[tuple[int, bytes]] = []
        self.inbox: queue.Queue[can.Message] = queue.Queue()
        self.error: Exception | None = None
        self.cut = False
        self.closed = False

    def send(self, message: can.Message) -> None:
        if self.error is not None:
            raise self.error
        self.sent.append((message.arbitration_id, bytes(message.data)))
        for drive in self.drives:
            if not self.cut:
                drive.take(message.arbitration_id, bytes(message.data))
        self.flush()

    def flush(self) -> None:
        for drive in self.drives:
            for cob_id, data in drive.out:
                if not self.cut:
                    self.put(cob_id, data)
            drive.out.clear()

    def put(self, cob_id: int, data: bytes) -> None:
        self.inbox.put(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def recv(self, timeout: float) -> can.Message | None:
        if self.error is not None:
            raise self.error
        try:
            return self.inbox.get(timeout=timeout)
        except queue.Empty:
            return None

    def shutdown(self) -> None:
        self.closed = True


class DriveBench:
    """Driver and supervisor on two scripted drives, cycle by cycle."""

    period = PERIOD
    command = staticmethod(Bench.step_command)

    def __init__(self, **parameters: Any) -> None:
        self.insertion, self.rotation = ScriptedDrive(1), ScriptedDrive(2)
        self.skipped = 0.0
        self.buses: list[ScriptedBus] = []
        self.no_adapter = False
        self.settings = DeviceDriverParameters(link="virtual", channel="test", **parameters)
        self.link = CanLink(self.settings.link_settings, self.clock, self.open)
        self.axes = [
            Cia402Axis(
                name,
                self.settings.drive(name),
                self.link,
                period=PERIOD,
                watchdog=self.settings.watchdog,
            )
            for name in ("insertion", "rotation")
        ]
        self.drives = DriveCycle(self.link, self.axes)
        self.supervisor = MotionSupervisor(
            self.axes[0],
            self.axes[1],
            self.settings.limits,
            feedback_delay=1,
            switching=lambda: self.drives.needs_cycles,
        )
        self.ros_ns = 1_000_000_000
        self.stamps = itertools.count(1)
        self.events: list[Event] = []
        self.wait = 2.0

    def clock(self) -> float:
        return time.monotonic() + self.skipped

    def open(self, settings: Any) -> Any:
        if self.no_adapter:
            raise LinkError(f"cannot open {settings}: no such file")
        self.buses.append(ScriptedBus([self.insertion, self.rotation]))
        return self.buses[-1]

    @property
    def bus(self) -> ScriptedBus:
        return self.buses[-1]

    @property
    def state(self) -> State:
        return self.supervisor.state

    @property
    def status(self) -> DeviceStatus:
        return self.supervisor.status(self.clock())

    @property
    def notices(self) -> list[Notice]:
        self.events += self.supervisor.take_events()
        return [event for event in self.events if isinstance(event, Notice)]

    @property
    def outcomes(self) -> list[str]:
        self.events += self.supervisor.take_events()
        return [event.outcome for event in self.events if isinstance(event, StepResult)]

    def cycle(self, count: int = 1, *, holding: bool = False, scale: float = 1.0) -> None:
        for _ in range(count):
            self.ros_ns += 20_000_000
            if holding:
                self.hold(scale=scale)
            now = self.clock()
            self.supervisor.note_time(self.ros_ns, now)
            self.drives.collect()
            self.supervisor.drive(PERIOD, now)
            self.drives.exchange(self.wait)
            self.supervisor.observe(self.clock())

    def hold(self, pressed: bool = True, *, scale: float = 1.0) -> None:
        message = HoldMessage("a", next(self.stamps), pressed, scale)
        self.supervisor.receive_hold(message, self.clock())

    def deliver(self, drive: ScriptedDrive) -> None:
        """Hand on what a drive said by itself, and wait until the link has taken it."""
        before = self.link.frames_received
        count = len(drive.out)
        self.bus.flush()
        with self.link.arrival:
            assert self.link.arrival.wait_for(
                lambda: self.link.frames_received >= before + count, 5.0
            )

    def configured(self) -> None:
        assert self.supervisor.configure(self.clock()).success
        self.cycle(2)

    def homed(self) -> None:
        self.configured()
        self.supervisor.confirm_needle_out(True)
        assert self.supervisor.home(self.clock()).success
        self.cycle(30)
        assert self.status.homed
        assert self.state is State.DISABLED

    def ready(self) -> None:
        self.homed()
        assert self.supervisor.enable(True, self.clock()).success
        self.cycle(12)
        self.hold(False)
        self.hold()

    def step(self, length: float = 0.001, rotation: float = 0.1, duration: float = 0.5) -> None:
        joints = self.supervisor.joints(self.clock())
        assert joints is not None
        self.supervisor.submit(
            Bench.step_command(
                joints.insertion + length, joints.rotation + rotation, self.ros_ns, duration
            ),
            self.clock(),
        )

    def moving(self) -> None:
        """Be in the middle of a step."""
        self.ready()
        self.cycle(1, holding=True)
        self.step(0.002, 0.2, 1.0)
        self.cycle(10, holding=True)
        assert self.state is State.MOVING
        assert self.insertion.position > 0

    @property
    def positions(self) -> tuple[int, int]:
        return self.insertion.position, self.rotation.position

    def close(self) -> None:
        with contextlib.suppress(AxisError):
            self.supervisor.close()
        self.link.close()


@pytest.fixture
def make_drive_bench() -> Iterator[Callable[..., DriveBench]]:
    benches: list[DriveBench] = []

    def make(**parameters: Any) -> DriveBench:
        benches.append(DriveBench(**parameters))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


@pytest.fixture
def drive_bench(make_drive_bench: Callable[..., DriveBench]) -> DriveBench:
    return make_drive_bench()


@pytest.fixture(scope="session")
def scripted_drive() -> type[ScriptedDrive]:
    return ScriptedDrive
