"""Who else is there: publishers, drivers and clocks beside the own, drives that are emulated."""

from __future__ import annotations

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from trajectory_msgs.msg import JointTrajectory

from needle_core.errors import UserError
from needle_core.ros.conversions import LATCHED, RELIABLE

from .node_bench import Make, Rig


def publishers(rig: Rig) -> int:
    return len(rig.driver.peers.publishers["device/joint_trajectory"])


def test_a_second_publisher_of_commands_moves_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    second = rig.partner.create_publisher(JointTrajectory, "device/joint_trajectory", RELIABLE)
    rig.until(lambda: publishers(rig) == 2, "second")
    outcome = rig.send(rig.message()).frame_id
    assert "2 nodes publish commands" in outcome
    rig.partner.destroy_publisher(second)
    rig.until(lambda: publishers(rig) == 1, "one again")
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
    assert "other_rig publishes device/status" in rig.partner.status["fault"]
    rig.hold(False)
    for name, data in (("home", None), ("enable", True), ("confirm_needle_out", True)):
        assert not rig.call(name, data).success
    assert "other_rig" in rig.call("reset").message
    assert rig.send(rig.message()).frame_id.startswith("aborted: ")
    other.destroy_node()
    rig.insist("reset")
    assert rig.positions == at


def test_a_driver_that_finds_another_device_does_not_start(make_rig: Make) -> None:
    rig = make_rig()
    other = rclpy.create_node("other_rig", context=rig.partner.context)
    other.create_publisher(DiagnosticStatus, "device/status", LATCHED)
    rig.until(lambda: rig.driver.exit is not None, "the refusal")
    assert rig.driver.exit is not None
    assert rig.driver.exit.code == 2
    assert "other_rig publishes device/status" in rig.driver.exit.text
    other.destroy_node()
