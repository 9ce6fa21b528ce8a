"""device_driver as a component, on emulated drives: cases not in the conformance kit."""

from __future__ import annotations

import random
from typing import Any

import pytest

from needle_core.can_frame import CanFrame
from needle_core.commands.cli import EXIT_INTERNAL_ERROR
from needle_core.component import LATCHED, Call, Component, Exit, Output
from needle_core.runners.transport import Arrival, Arrivals, Link
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.link import DriveError
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig
from needle_device_driver.device import JOINTS, STATUS
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.procedure import Procedure

SYNC = 0x080


def restarted(rig: ConformanceRig, search_from: float = 0.0) -> ConformanceRig:
    """Restart the driver, so that it searches for its drives at that time [s]."""
    rig.runner.kill(DRIVER)
    rig.driver = DeviceDriver(rig.settings, search_from=search_from)
    rig.runner.start(rig.driver)
    rig.runner.run(0.3)
    return rig


def answer(rig: ConformanceRig, name: str, request: bool | None = None) -> str:
    """Call a service; return its reply."""
    rig.hand.answers.clear()
    rig.hand.actions.append(Call(f"device/{name}", request))
    rig.until(lambda: bool(rig.hand.answers), name)
    return rig.hand.answers[0].text


def test_search_waits_for_the_discovery_of_other_devices() -> None:
    rig = restarted(ConformanceRig(1), 0.5)
    assert {row.max_bytes for row in rig.driver.inputs} == {4096}
    assert answer(rig, "home") == "waiting for the drives"
    rig.runner.run(0.5 - rig.runner.now)
    assert rig.driver.drives[0].link.counts["frames_sent"] == "0"
    rig.start()
    assert rig.driver.drives[0].health("").message == "connected"
    rig = restarted(ConformanceRig(1), 0.5)
    other = Component()
    other.name, other.outputs = "/sim_rig", (Output(STATUS, DeviceStatus, LATCHED),)
    rig.runner.start(other)
    rig.runner.run(0.5)
    assert (rig.runner.exits[DRIVER].code, "/sim_rig" in rig.runner.exits[DRIVER].text) == (2, True)


def test_driver_waits_for_missing_drives_and_exits_on_refusal() -> None:
    rig = ConformanceRig(1, driver={"connect_timeout": 3.0})
    rig.emulator("rotation").hang("rotation")
    rig.runner.run(3.0)
    assert "rotation axis: node 2 does not answer" in answer(rig, "home")
    assert len(rig.logged) == 1, "said once"
    rig.runner.run(2.0)
    (leave,) = rig.runner.exits.values()
    assert (leave.code, "node 2 does not answer" in leave.text) == (2, True)
    rig = ConformanceRig(1)
    objects = rig.emulator("insertion").drives["insertion"]._objects
    del objects._entries[0x605A, 0]
    rig.runner.run(1.0)
    (leave,) = rig.runner.exits.values()
    assert (leave.code, "refuses to write 6 to 0x605A:0" in leave.text) == (2, True)


def test_second_master_is_forgotten_when_the_link_is_reopened() -> None:
    rig = ConformanceRig(1)
    rig.emulator("rotation").hang("rotation")
    rig.runner.run(0.2)
    (drives,) = rig.driver.drives
    drives.receive((CanFrame(0x000, b"\x01\x00"),))
    rig.runner.lose_port(DRIVER, "can", "unplugged")
    rig.runner.run(0.1)
    assert drives.health("").message == "link virtual can is lost: unplugged"
    rig.runner.open_port(DRIVER, "can")
    rig.emulator("rotation").restore(rig.runner.now)
    rig.start()
    assert rig.hand.status.fault == ""


@pytest.mark.parametrize("how", ["stop", "disable", "emergency stop", "silence"])
def test_slow_procedure_is_cancelled(how: str) -> None:
    rig = ConformanceRig(1)
    rig.start()
    rig.call("device/confirm_needle_out", True)
    rig.emulator("rotation").hang("rotation")
    rig.hand.answers.clear()
    rig.hand.actions.append(Call("device/home"))
    rig.runner.run(0.05)
    rig.hand.actions.append(Call("device/reset"))
    rig.runner.run(0.02)
    if how == "stop":
        rig.hand.actions.append(Call("device/stop"))
    elif how == "disable":
        rig.hand.actions.append(Call("device/enable", False))
    elif how == "emergency stop":
        rig.driver.supervisor.receive_estop(True)
    rig.runner.run(1.0)
    replies = {reply.service: reply for reply in rig.hand.answers}
    assert replies["device/reset"].text == "another command is running"
    home = replies["device/home"]
    assert not home.success
    assert ("cancelled" if how != "silence" else "no reply") in home.text
    assert rig.is_at_rest()


def breaks(*_: Any) -> Any:
    raise ZeroDivisionError("planted")


def test_internal_error_stops_both_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = ConformanceRig(1)
    rig.moving()
    monkeypatch.setattr(rig.driver.supervisor, "receive_hold", breaks)
    rig.runner.run(0.2)
    text = "internal error: ZeroDivisionError: planted"
    assert rig.hand.status.fault == text
    assert rig.is_at_rest()
    assert DRIVER not in rig.runner.exits
    monkeypatch.setattr(rig.driver.supervisor, "drive", breaks)
    rig.runner.run(0.1)
    assert rig.runner.exits[DRIVER] == Exit(EXIT_INTERNAL_ERROR, text)
    rig = ConformanceRig(1)
    rig.start()
    rig.call("device/confirm_needle_out", True)
    monkeypatch.setattr("needle_device_driver.cia402.cia402_axis.write_homing", breaks)
    assert answer(rig, "home") == "cancelled: internal error"


def test_drive_that_refuses_its_limits_is_never_enabled() -> None:
    rig = ConformanceRig(1, axis="galil")

    def refused(*_: object) -> Procedure[None]:
        yield from ()
        raise DriveError("refuses its limits")

    rig.start()
    rig.insertion_protocol.write_limits = refused
    rig.begin_homing()
    for _ in range(2):
        rig.until(lambda: rig.state == "FAULT", "the refusal")
        rig.runner.run(1.0)
        rig.call("device/reset")
        rig.hand.actions.append(Call("device/enable", True))
    rig.runner.run(1.0)
    assert rig.state == "FAULT"
    assert rig.hand.status.fault.startswith("insertion axis: refuses its limits")


def test_status_rate_is_limited_for_positions() -> None:
    rig = ConformanceRig(1)
    rig.moving(duration=4.0)
    changed = []
    for _ in range(50):
        before = rig.hand.status
        rig.runner.run(PERIOD)
        changed.append(rig.hand.status is not before)
    assert 1 <= changed.count(True) <= 2


def test_joint_states_carry_the_time_of_the_sync() -> None:
    syncs, stamps = set[int](), set[int]()

    def watch(link: Link, message: Any, now: float, _: random.Random) -> Arrivals:
        if link.topic == JOINTS:
            stamps.add(message.stamp_ns)
        elif link.sender == DRIVER and link.topic in rig.drives.connections:
            syncs.update(
                rig.runner.timeline.stamp_ns for frame in message if frame.identifier == SYNC
            )
        return (Arrival(0.0, message),)

    rig = ConformanceRig(1, faults=(watch,))
    rig.start()
    rig.runner.run(0.1)
    assert len(stamps) >= 5
    # The drives receive the SYNC up to 1 ms after it was sent, and reply after that.
    assert all(any(0 <= sync - stamp < 1_000_000 for sync in syncs) for stamp in stamps)
