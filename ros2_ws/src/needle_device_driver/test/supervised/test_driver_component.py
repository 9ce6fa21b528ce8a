"""device_driver as a component, on scripted drives."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from needle_core import messages as m
from needle_core.can_frame import CanFrame
from needle_core.component import (
    Actions,
    Diagnose,
    Exit,
    Log,
    Moment,
    Peers,
    PortChange,
    Publish,
    Reply,
    Send,
)
from needle_device_driver.device_driver import EXIT_BROKEN, DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters

from .scripted_drives import ScriptedBus, ScriptedDrive

PERIOD = 0.02


class DriverBench:
    """The component with virtual time."""

    def __init__(self, **parameters: Any) -> None:
        settings = DeviceDriverParameters(link="virtual", channel="test", **parameters)
        self.driver = DeviceDriver(settings, "/device_driver", search_from=10.05)
        self.drives = [ScriptedDrive(1), ScriptedDrive(2)]
        self.frames: list[CanFrame] = []
        self.bus = ScriptedBus(self.drives, self.frames.append)
        self.now = 10.0
        self.numbers = itertools.count(1)
        self.status = self.driver.supervisor.status(self.now)
        self.actions: list[Any] = []
        self.rows = {row.topic: row.handler for row in self.driver.inputs}
        self.services = {row.name: row.handler for row in self.driver.services}

    @property
    def at(self) -> Moment:
        return Moment(self.now, 1_000_000_000 + round(self.now * 1e9))

    def perform(self, actions: Actions) -> None:
        """Perform the actions of a handler; the drives answer after 0.5 ms."""
        for action in actions:
            match action:
                case Send(_, batch):
                    for frame in batch:
                        self.bus.send(frame.identifier, frame.data)
                case Publish("device/status", message):
                    self.status = message
                case _:
                    self.actions.append(action)
        if self.frames and self.exits == []:
            answers, self.frames[:] = tuple(self.frames), []
            self.now += 0.0005
            self.perform(self.driver.ports[0].handler(answers, self.at))

    def of(self, kind: type[Any]) -> list[Any]:
        return [action for action in self.actions if isinstance(action, kind)]

    @property
    def exits(self) -> list[tuple[int, str]]:
        return [(action.code, action.text) for action in self.of(Exit)]

    @property
    def outcomes(self) -> list[str]:
        published = [action.message for action in self.of(Publish)]
        return [one.outcome for one in published if isinstance(one, m.CommandResult)]

    def run(self, cycles: int, *, holding: bool = False) -> None:
        for _ in range(cycles):
            if self.exits:
                return
            self.now = round(self.now / PERIOD + 1) * PERIOD
            if holding:
                self.hold()
            self.perform(self.driver.timers[0].handler(self.at))

    def receive(self, topic: str, message: Any) -> None:
        self.perform(self.rows[topic](message, self.at))

    def hold(self, pressed: bool = True) -> None:
        self.receive(
            "device/hold", m.HoldState("person", "", next(self.numbers), pressed, 1.0, 0.1)
        )

    def call(self, name: str, argument: bool | None = None) -> Reply:
        number = next(self.numbers)
        self.perform(self.services[f"device/{name}"](argument, number, self.at))
        return self.answer(number)

    def answer(self, number: int) -> Reply:
        (reply,) = [a for a in self.actions if isinstance(a, Reply) and a.request == number]
        return reply

    def set_up(self) -> DriverBench:
        self.run(10)
        assert self.status.state == "DISABLED", self.actions
        return self

    def ready(self) -> DriverBench:
        self.set_up()
        assert self.call("confirm_needle_out", True).success
        assert self.call("home").success
        self.run(30)
        assert self.call("enable", True).success
        self.run(12)
        self.hold(False)
        self.hold()
        return self

    def step(self, length: float = 0.002) -> None:
        point = m.TrajectoryPoint((self.drives[0].position / 2e7 + length, 0.1), 1.0)
        names = m.INSERTION_JOINT, m.ROTATION_JOINT
        self.receive("device/joint_trajectory", m.Trajectory(self.at.stamp_ns, names, (point,)))

    def moving(self) -> DriverBench:
        self.ready()
        self.step()
        self.run(10, holding=True)
        assert self.status.state == "MOVING"
        return self

    def set_peers(self, *, commands: int = 1, others: tuple[str, ...] = ()) -> None:
        names = ("/device_driver", *others)
        topics = {"device/joint_trajectory": ("/c",) * commands, "device/status": names}
        self.perform(self.driver.on_peers(Peers(topics), self.at))


def test_driver_sets_up_homes_and_moves_the_drives() -> None:
    bench = DriverBench()
    bench.run(2)
    assert bench.bus.sent == [], "another device shows itself before"
    assert bench.call("home").text == "waiting for the drives"
    assert {row.max_bytes for row in bench.driver.inputs} == {4096}
    bench.ready()
    assert bench.status.simulated is False
    bench.actions.clear()
    bench.step()
    bench.run(60, holding=True)
    assert bench.outcomes == ["succeeded"]
    assert [drive.position for drive in bench.drives] == [40_000, round(0.1 * 65536 / 6.2831853)]
    joints = [a.message for a in bench.of(Publish) if isinstance(a.message, m.JointState)]
    assert len(joints) == 60
    assert joints[-1].positions == pytest.approx((0.002, 0.1), abs=1e-4)
    # The drives sampled the joints at the SYNC, at the begin of the cycle.
    assert joints[-1].stamp_ns == 1_000_000_000 + round(round(bench.now / PERIOD) * PERIOD * 1e9)
    bench.perform(bench.driver.timers[1].handler(bench.at))
    health = bench.of(Diagnose)[-1].diagnostic
    assert (health.message, health.values["unanswered_cycles"]) == ("connected", "0")


def test_estop_and_release_act_between_cycles() -> None:
    bench = DriverBench().moving()
    bench.hold(False)
    assert bench.outcomes == ["aborted: hold released"]
    bench.hold()
    bench.step()
    bench.run(5, holding=True)
    bench.receive("device/estop", m.EmergencyStop(True))
    assert [drive.state for drive in bench.drives] == ["quick stop"] * 2
    assert (bench.status.state, bench.status.text) == ("ESTOPPED", "emergency stop")
    assert bench.of(Log)[-1] == Log("error", "emergency stop [estop_latches]")
    bench.receive("device/estop", m.EmergencyStop(False))
    bench.hold(False)
    bench.run(12)
    assert bench.call("reset").success
    assert bench.status.state == "DISABLED"


def test_exit_during_a_step_switches_the_drives_off() -> None:
    bench = DriverBench().moving()
    bench.perform(bench.driver.on_stop(bench.at))
    bench.run(10)
    assert bench.exits == [(0, "")]
    assert [drive.state for drive in bench.drives] == ["disabled"] * 2
    assert [drive.value(0x1016, 1) for drive in bench.drives] == [0, 0]
    assert bench.call("enable", True).text == "waiting for the drives"


def test_one_device_and_command_one_publisher_count_peers() -> None:
    bench = DriverBench().ready()
    bench.set_peers(commands=2)
    bench.step()
    assert bench.outcomes == ["aborted: 2 nodes publish commands, expected 1"]
    bench.set_peers()
    bench.run(1, holding=True)
    bench.step()
    bench.set_peers(others=("/sim_rig",))
    assert bench.status.state == "FAULT"
    assert "another device is running: /sim_rig publishes device/status" in bench.status.fault
    bench.hold(False)
    assert not bench.call("reset").success
    assert bench.exits == []
    bench = DriverBench()
    bench.set_peers(others=("/sim_rig",))
    ((code, text),) = bench.exits
    assert (code, "/sim_rig" in text) == (2, True)


def test_driver_waits_for_missing_drives_and_exits_on_refusal() -> None:
    bench = DriverBench(connect_timeout=3.0)
    bench.drives[1].silent = True
    bench.run(150)
    assert "rotation axis: node 2 does not answer" in bench.call("home").text
    assert len(bench.of(Log)) == 1, "said once"
    assert bench.exits == []
    bench.run(60)
    ((code, text),) = bench.exits
    assert (code, "node 2 does not answer" in text) == (2, True)
    bench = DriverBench()
    bench.drives[0].missing_objects = {0x1016}
    bench.run(10)
    ((code, text),) = bench.exits
    assert (code, "refuses to write 0 to 0x1016:1" in text) == (2, True)


def test_link_loss_is_an_immediate_fault_until_reset() -> None:
    bench = DriverBench().moving()
    port = bench.driver.ports[0]
    bench.perform(port.on_change(PortChange("unplugged"), bench.at))
    assert bench.status.fault == "insertion axis: link virtual test is lost: unplugged; " + (
        "rotation axis: link virtual test is lost: unplugged"
    )
    bench.bus.sent.clear()
    bench.hold(False)
    bench.run(10)
    assert bench.bus.sent == []
    assert "cannot open virtual test: unplugged" in bench.call("reset").text
    bench.perform(bench.driver.timers[1].handler(bench.at))
    assert bench.of(Diagnose)[-1].diagnostic.message == "link virtual test is lost: unplugged"
    bench.perform(port.on_change(PortChange(), bench.at))
    assert bench.call("reset").success
    assert bench.status.state == "DISABLED"


def test_second_master_is_forgotten_when_the_link_is_reopened() -> None:
    bench = DriverBench()
    port = bench.driver.ports[0]
    bench.drives[1].silent = True
    bench.run(10)
    bench.perform(port.handler((CanFrame(0x000, b"\x01\x00"),), bench.at))
    bench.perform(port.on_change(PortChange("unplugged"), bench.at))
    bench.perform(port.on_change(PortChange(), bench.at))
    bench.drives[1].silent = False
    bench.run(40)
    assert (bench.status.state, bench.status.fault) == ("DISABLED", "")


@pytest.mark.parametrize("how", ["stop", "disable", "emergency stop", "silence"])
def test_slow_procedure_is_cancelled(how: str) -> None:
    bench = DriverBench().set_up()
    bench.call("confirm_needle_out", True)
    bench.drives[1].silent = True
    number = next(bench.numbers)
    bench.perform(bench.services["device/home"](None, number, bench.at))
    bench.run(2)
    assert bench.call("reset").text == "another command is running"
    if how == "stop":
        assert bench.call("stop").success
    elif how == "disable":
        assert bench.call("enable", False).success
    elif how == "emergency stop":
        bench.receive("device/estop", m.EmergencyStop(True))
    else:
        bench.run(60)
    reply = bench.answer(number)
    assert not reply.success
    assert ("cancelled" if how != "silence" else "no reply") in reply.text
    bench.bus.sent.clear()
    bench.run(20)
    assert not [cob for cob, _ in bench.bus.sent if cob in (0x601, 0x602)]
    assert {data[0] for cob, data in bench.bus.sent if cob in (0x201, 0x202)} <= {0x00, 0x02}


def _breaks(*_: Any) -> Any:
    raise ZeroDivisionError("planted")


def test_internal_error_stops_both_axes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = DriverBench().moving()
    monkeypatch.setattr(bench.driver.supervisor, "submit", _breaks)
    with pytest.raises(ZeroDivisionError):
        bench.step()
    assert bench.status.fault == "internal error: ZeroDivisionError: planted"
    assert [drive.state for drive in bench.drives] == ["quick stop"] * 2
    assert bench.exits == []
    monkeypatch.setattr(bench.driver.supervisor, "drive", _breaks)
    with pytest.raises(ZeroDivisionError):
        bench.run(1)
    assert bench.exits == [(EXIT_BROKEN, "internal error: ZeroDivisionError: planted")]
    bench = DriverBench().set_up()
    bench.call("confirm_needle_out", True)
    monkeypatch.setattr("needle_device_driver.cia402.cia402_axis.write_homing", _breaks)
    with pytest.raises(ZeroDivisionError):
        bench.call("home")
    assert bench.of(Reply)[-1].text == "cancelled: internal error"


def test_status_rate_is_limited_for_positions() -> None:
    bench = DriverBench().moving()
    told = []
    for _ in range(40):
        before = bench.status
        bench.run(1, holding=True)
        told.append(bench.status is not before)
    assert told.count(True) == 1
