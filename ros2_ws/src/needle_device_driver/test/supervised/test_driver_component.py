"""device_driver as a component, on emulated drives: cases not in the conformance kit."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest

from needle_core.commands.cli import EXIT_INTERNAL_ERROR
from needle_core.component import LATCHED, Call, Component, Exit, Output
from needle_core.runners.transport import Arrival, Arrivals, Link
from needle_core.status_messages import DeviceStatus
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig
from needle_device_driver.device import JOINTS, STATUS
from needle_device_driver.device_driver import DeviceDriver

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
    assert answer(rig, "home") == "waiting for the drives"
    rig.runner.run(0.5 - rig.runner.now)
    assert rig.driver.drives[0].link.counts["frames_sent"] == "0"
    rig.start()
    rig = restarted(ConformanceRig(1), 0.5)
    other = Component()
    other.name, other.outputs = "/sim_rig", (Output(STATUS, DeviceStatus, LATCHED),)
    rig.runner.start(other)
    rig.runner.run(0.5)
    ended = rig.runner.exits[DRIVER]
    assert (ended.code, "/sim_rig" in ended.text) == (2, True)


def test_driver_waits_for_missing_drives() -> None:
    rig = ConformanceRig(1, driver={"connect_timeout": 3.0})
    rig.emulator("rotation").hang("rotation")
    rig.runner.run(3.0)
    assert "rotation axis: node 2 does not answer" in answer(rig, "home")
    assert len(rig.logged) == 1, "said once"
    rig.runner.run(2.0)
    ended = rig.runner.exits[DRIVER]
    assert (ended.code, "node 2 does not answer" in ended.text) == (2, True)


def test_driver_exits_if_a_drive_is_unsuitable() -> None:
    rig = ConformanceRig(1)
    del rig.emulator("insertion").drives["insertion"]._objects._entries[0x605A, 0]
    rig.runner.run(1.0)
    ended = rig.runner.exits[DRIVER]
    assert (ended.code, "refuses to write 6 to 0x605A:0" in ended.text) == (2, True)


@pytest.mark.parametrize(
    ("how", "outcome"),
    [
        (lambda rig: rig.hand.actions.append(Call("device/enable", False)), "cancelled"),
        (lambda rig: rig.driver.supervisor.receive_estop(True), "cancelled"),
        (lambda _: None, "no reply"),
    ],
    ids=["disable", "emergency stop", "silence"],
)
def test_slow_procedure_is_cancelled(how: Callable[[ConformanceRig], None], outcome: str) -> None:
    rig = ConformanceRig(1)
    rig.start()
    rig.call("device/confirm_needle_out", True)
    rig.emulator("rotation").hang("rotation")
    rig.hand.answers.clear()
    rig.hand.actions.append(Call("device/home"))
    rig.runner.run(0.05)
    rig.hand.actions.append(Call("device/reset"))
    rig.runner.run(0.02)
    how(rig)
    rig.runner.run(1.0)
    replies = {reply.service: reply for reply in rig.hand.answers}
    assert replies["device/reset"].text == "another command is running"
    assert not replies["device/home"].success
    assert outcome in replies["device/home"].text
    assert rig.is_at_rest()


def fail_internally(*_: Any) -> Any:
    raise ZeroDivisionError("planted")


def test_internal_error_stops_both_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = ConformanceRig(1)
    rig.moving()
    monkeypatch.setattr(rig.driver.supervisor, "receive_hold", fail_internally)
    rig.runner.run(0.2)
    text = "internal error: ZeroDivisionError: planted"
    assert rig.hand.status.fault == text
    assert rig.is_at_rest()
    assert DRIVER not in rig.runner.exits
    monkeypatch.setattr(rig.driver.supervisor, "drive", fail_internally)
    rig.runner.run(0.1)
    assert rig.runner.exits[DRIVER] == Exit(EXIT_INTERNAL_ERROR, text)


def test_internal_error_cancels_a_procedure(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = ConformanceRig(1)
    rig.start()
    rig.call("device/confirm_needle_out", True)
    monkeypatch.setattr("needle_device_driver.cia402.cia402_axis.write_homing", fail_internally)
    assert answer(rig, "home") == "cancelled: internal error"


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
