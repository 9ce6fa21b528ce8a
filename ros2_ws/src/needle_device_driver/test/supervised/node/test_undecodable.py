"""Messages that cannot be decoded: counted by their topic, and nothing ends by them."""

from __future__ import annotations

from std_msgs.msg import Bool

from .node_bench import Make

UNDECODABLE = b"\x00\x01\x00"


def test_an_emergency_stop_is_kept_when_undecodable_bytes_follow_it(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.partner.estops.publish(Bool(data=True))
    rig.partner.estops.publish(UNDECODABLE)
    rig.until(lambda: rig.partner.refused == {"device/estop": 1}, "the count")
    rig.until(lambda: rig.partner.status["state"] == "ESTOPPED", "emergency stop")
    rig.hold(False)
    rig.until(lambda: rig.partner.status["hold_owner"] == "", "release")
    assert rig.call("reset").message == "the emergency stop is still pressed"


def test_undecodable_bytes_on_hold_and_commands_end_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    for publisher in (rig.partner.holds, rig.partner.commands):
        publisher.publish(UNDECODABLE)
    rig.partner.commands.publish(message := rig.message())
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    for publisher in (rig.partner.commands, rig.partner.holds):
        publisher.publish(UNDECODABLE)
    rig.hold()
    rig.until(lambda: bool(rig.partner.results), "the step's end")
    assert rig.partner.results[-1].stamp == message.header.stamp
    assert rig.partner.results[-1].frame_id == "succeeded"
    rig.until(
        lambda: rig.partner.refused == {"device/hold": 2, "device/joint_trajectory": 2}, "counts"
    )


def test_a_release_before_undecodable_bytes_is_heard(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.hold(False)
    rig.partner.holds.publish(UNDECODABLE)
    rig.until(lambda: bool(rig.partner.results), "the end")
    assert rig.partner.results[-1].frame_id == "aborted: hold released"
    rig.until(lambda: rig.partner.status["state"] == "HOLDING", "held")
