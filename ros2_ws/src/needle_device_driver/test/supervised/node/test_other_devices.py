"""Who else is there: publishers, drivers and clocks beside the own, drives that are emulated."""

from __future__ import annotations

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from rosgraph_msgs.msg import Clock
from trajectory_msgs.msg import JointTrajectory

from needle_core.errors import UserError
from needle_core.ros.conversions import LATCHED, RELIABLE
from needle_device_driver import device_driver
from needle_device_driver.ros import device_driver as device_driver_node

from .node_bench import Make, emulated_as


def test_a_second_publisher_of_commands_moves_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    second = rig.partner.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
    rig.until(lambda: rig.driver.count_publishers("device/joint_trajectory") == 2, "second")
    outcome = rig.send(rig.message()).frame_id
    assert "2 nodes publish commands" in outcome
    rig.partner.destroy_publisher(second)
    rig.until(lambda: rig.driver.count_publishers("device/joint_trajectory") == 1, "one again")
    rig.tick()
    assert rig.send(rig.message()).frame_id == "succeeded"


def test_a_second_driver_beside_a_first_is_refused_by_name(make_rig: Make) -> None:
    make_rig()
    with pytest.raises(UserError, match=r"/device_driver \(process \d+\) has /device/status"):
        make_rig()


def test_another_device_stops_everything_until_it_is_gone_and_reset(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    at = rig.positions
    other = rclpy.create_node("other_rig", context=rig.partner.context)
    other.create_publisher(DiagnosticStatus, "device/status", LATCHED)
    rig.until(lambda: rig.partner.status["state"] == "FAULT", "a fault")
    assert "/other_rig publishes device/status" in rig.partner.status["fault"]
    rig.hold(False)
    for name, data in (("home", None), ("enable", True), ("confirm_needle_out", True)):
        assert not rig.call(name, data).success
    assert "/other_rig" in rig.call("reset").message
    assert rig.send(rig.message()).frame_id.startswith("aborted: ")
    other.destroy_node()
    rig.until(lambda: rig.call("reset").success, "alone again")
    assert rig.positions == at


def test_a_driver_that_finds_another_device_does_not_start(make_rig: Make) -> None:
    rig = make_rig()
    other = rclpy.create_node("other_rig", context=rig.partner.context)
    other.create_publisher(DiagnosticStatus, "device/status", LATCHED)
    with pytest.raises(UserError, match="/other_rig publishes device/status"):
        rig.until(lambda: False, "the refusal")
    other.destroy_node()


@pytest.mark.parametrize("opened", [False, True])
def test_on_an_open_network_it_looks_for_another_device_before_it_begins(
    make_rig: Make, monkeypatch: pytest.MonkeyPatch, opened: bool
) -> None:
    monkeypatch.setattr(device_driver_node, "is_open", lambda: opened)
    monkeypatch.setattr(device_driver_node, "DISCOVERY", 0.5)
    begin = time.monotonic()
    rig = make_rig()
    rig.until(lambda: rig.driver._component.link.is_open, "the first word to the drives")
    # It was made before: at the earliest half a second after this test began.
    assert not opened or time.monotonic() - begin >= 0.5


@pytest.mark.parametrize(
    ("emulated", "use_sim_time", "simulated"),
    [(True, True, "true"), (True, False, "false"), (False, True, "false")],
)
def test_simulated_is_what_has_emulated_drives_and_simulated_time(
    make_rig: Make,
    monkeypatch: pytest.MonkeyPatch,
    emulated: bool,
    use_sim_time: bool,
    simulated: str,
) -> None:
    monkeypatch.setattr(device_driver, "are_emulated", emulated_as(emulated))
    rig = make_rig(autostart=False, use_sim_time=use_sim_time, lock_step=False)
    rig.until(rig.partner.change.service_is_ready, "the driver")
    assert rig.partner.status.get("simulated", "") == ""
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    rig.until(lambda: rig.partner.status.get("simulated") == simulated, "what it is")


def test_lock_step_is_refused_where_a_drive_does_not_say_that_it_is_emulated(
    make_rig: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_driver, "are_emulated", emulated_as(False))
    rig = make_rig(lock_step=True)
    with pytest.raises(UserError, match="lock_step: a drive does not say that it is emulated"):
        rig.until(lambda: False, "the refusal")
    assert all(drive.objects.get((0x1016, 1), bytes(4)) == bytes(4) for drive in rig.peer.drives)


def test_a_clock_that_is_too_fast_makes_no_motion_faster(make_rig: Make) -> None:
    rig = make_rig(lock_step=False)
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=0.3))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    begun, syncs, end = time.monotonic(), rig.peer.syncs, len(rig.partner.results)

    def hurry() -> bool:
        rig.time_ns += 20_000_000
        rig.tell_time()
        return len(rig.partner.results) > end

    rig.until(hurry, "the end of the step")
    assert rig.partner.results[-1].frame_id == "succeeded"
    assert (rig.peer.syncs - syncs) * 0.02 <= time.monotonic() - begun + 0.04


def test_a_second_clock_is_named_and_stops_both_axes(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(5)
    second = rclpy.create_node("second", context=rig.driver.context)
    second.create_publisher(Clock, "/clock", RELIABLE)
    rig.until(lambda: rig.driver.count_publishers("/clock") == 2, "second")
    rig.tell_time()
    rig.until(lambda: rig.partner.status["state"] == "FAULT", "the fault")
    assert rig.partner.status["fault"] == "2 nodes publish /clock, wanted 1: /partner, /second"
    at = rig.positions
    assert "2 nodes publish /clock" in rig.call("reset").message
    second.destroy_node()
    rig.until(lambda: rig.driver.count_publishers("/clock") == 1, "one again")
    rig.hold(False)
    rig.until(lambda: bool(rig.call("reset").success), "reset")
    rig.tick(3)
    assert rig.positions == at
