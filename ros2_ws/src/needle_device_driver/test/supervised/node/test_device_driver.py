"""The device_driver node: steps, refusals, lifecycle, start and end."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory

from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain
from needle_core.ros.conversions import to_nanoseconds

from .node_bench import Make, Rig


def test_steps_end_where_they_should_and_each_tick_is_one_sync(make_rig: Make) -> None:
    rig = make_rig(lock_step=True)
    rig.ready()
    syncs, joints = rig.peer.syncs, len(rig.partner.joints)
    message = rig.message()
    assert rig.send(message).frame_id == "succeeded"
    assert rig.partner.results[-1].stamp == message.header.stamp
    assert rig.positions == [20_000, round(0.1 * 65536 / (2 * math.pi))]
    assert rig.peer.syncs - syncs == len(rig.partner.joints) - joints
    rig.tick(3)
    # Time stands still: its repetition repeats the joints and moves nothing on.
    syncs, joints = rig.peer.syncs, len(rig.partner.joints)
    rig.tell_time()
    rig.until(lambda: len(rig.partner.joints) > joints, "repeated joints")
    assert rig.peer.syncs == syncs
    assert list(rig.partner.joints[-1].position) == list(rig.partner.joints[-2].position)


def test_bad_commands_are_refused_whole_and_disturb_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    assert rig.send(rig.message()).frame_id == "succeeded"
    rig.tick(2)
    at = rig.positions
    here = list(rig.partner.joints[-1].position)
    bad: dict[str, JointTrajectory] = {
        "not finite": rig.message([math.nan, 0.0]),
        "infinite": rig.message([math.inf, 0.0]),
        "not newer": rig.message(stamp_ns=rig.time_ns - 10_000_000_000),
        "future": rig.message(stamp_ns=rig.time_ns + 5_000_000_000),
        "wanted insertion_joint": rig.message(names=["insertion_joint", "roll_joint"]),
        "does not rise": rig.message(points=2),
        "0 points": rig.message(points=0),
        "positions": rig.message([0.001]),
        "step 3 mm": rig.message([here[0] + 0.003, here[1]]),
        # Millimetres for metres, degrees for radians.
        "depth 2000 mm": rig.message([2.0, here[1]]),
        "not ahead": rig.message([here[0] - 0.001, here[1]]),
        "rotation 57.2": rig.message([here[0] + 0.001, here[1] + math.degrees(1.0)]),
        "speed": rig.message(duration=0.01),
        "time_from_start": rig.message(duration=0.0),
    }
    for number, (text, message) in enumerate(bad.items(), start=1):
        outcome = rig.send(message).frame_id
        assert outcome.startswith("aborted: "), text
        if text != "infinite":
            assert text in outcome
        assert rig.positions == at
        rig.until_refused(number)
    # In the middle of a step, too.
    rig.tick()
    good = rig.message()
    rig.partner.commands.publish(good)
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(3)
    for message in (rig.message([math.nan, 0.0], stamp_ns=rig.time_ns), rig.message(points=3)):
        before = len(rig.partner.results)
        rig.partner.commands.publish(message)
        rig.until_answered(before)
        assert rig.partner.results[-1].frame_id.startswith("aborted: ")
    rig.tick_until(lambda: rig.partner.status["state"] == "HOLDING", "end")
    assert [r.frame_id for r in rig.partner.results if r.stamp == good.header.stamp][-1] == (
        "succeeded"
    )
    assert rig.positions[0] == at[0] + 20_000


def test_the_last_stamp_that_there_is_is_refused_and_answered(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    message = rig.message()
    message.header.stamp = Time(sec=2**31 - 1, nanosec=2**32 - 1)
    answer = rig.send(message)
    assert "from the future" in answer.frame_id
    assert answer.stamp == message.header.stamp


def test_a_long_command_or_hold_is_refused_unread(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(points=10_000))
    long_name = Joy(axes=[1.0], buttons=[1])
    long_name.header.frame_id = "n" * 1_000_000
    rig.partner.holds.publish(long_name)
    rig.until(lambda: set(rig.partner.refused) == {"device/joint_trajectory", "device/hold"}, "two")
    assert rig.send(rig.message()).frame_id == "succeeded"
    assert rig.partner.status["commands_refused"] == "0"


def test_the_node_of_the_cycle_has_no_service_that_takes_long_requests(make_rig: Make) -> None:
    rig = make_rig()
    names = [name.rpartition("/")[2] for name in _services_of(rig)]
    assert "change_state" in names
    assert not [name for name in names if "parameter" in name]


def _services_of(rig: Rig) -> list[str]:
    return [service.srv_name for service in rig.driver.services]


def test_the_emergency_stop_stops_both_drives_and_its_reset_moves_nothing(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(5)
    rig.partner.estops.publish(Bool(data=True))
    rig.until(lambda: rig.partner.status["state"] == "ESTOPPED", "emergency stop")
    rig.until(
        lambda: [drive.state for drive in rig.peer.drives] == ["quick stop"] * 2, "quick stops"
    )
    at = rig.positions
    rig.tick(3)
    assert not rig.call("reset").success
    rig.partner.estops.publish(Bool(data=False))
    rig.hold(False)
    rig.until(lambda: bool(rig.call("reset").success), "reset")
    rig.tick(10)
    assert rig.partner.status["state"] == "DISABLED"
    assert [drive.state for drive in rig.peer.drives] == ["disabled"] * 2
    assert rig.positions == at


def test_the_lifecycle_ends_in_switched_off_drives_and_begins_again(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    assert rig.label == "active"
    # A transition that this state does not have ends nothing.
    assert not rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.label == "active"
    rig.partner.commands.publish(rig.message(duration=1.0))
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(3)
    assert rig.transition(Transition.TRANSITION_DEACTIVATE)
    rig.until(lambda: rig.partner.status["state"] == "DISABLED", "disabled")
    rig.tick_until(
        lambda: [drive.state for drive in rig.peer.drives] == ["disabled"] * 2, "switched off"
    )
    assert "activated" in rig.call("enable", True).message
    assert rig.transition(Transition.TRANSITION_CLEANUP)
    rig.until(lambda: rig.partner.status["state"] == "UNCONFIGURED", "unconfigured")
    assert all(drive.objects[0x1016, 1] == bytes(4) for drive in rig.peer.drives)
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.transition(Transition.TRANSITION_ACTIVATE)
    rig.until(lambda: rig.partner.status["state"] == "DISABLED", "configured again")
    assert rig.partner.status["homed"] == "false"
    assert rig.transition(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert rig.driver.ended


def test_its_end_in_the_middle_of_a_step_leaves_the_drives_off(make_rig: Make) -> None:
    rig = make_rig()
    rig.ready()
    message = rig.message(duration=1.0)
    rig.partner.commands.publish(message)
    rig.until(lambda: rig.partner.status["state"] == "MOVING", "step")
    rig.tick(5)
    rig.driver.close()
    at = rig.positions
    assert [drive.state for drive in rig.peer.drives] == ["disabled"] * 2
    assert all(drive.objects[0x1016, 1] == bytes(4) for drive in rig.peer.drives)
    rig.until(lambda: bool(rig.partner.results), "result")
    assert rig.partner.results[-1].stamp == message.header.stamp
    assert rig.partner.results[-1].frame_id.startswith("aborted: ")
    assert rig.positions == at


def test_without_autostart_nothing_is_configured_until_it_is_asked_for(make_rig: Make) -> None:
    rig = make_rig(autostart=False)
    rig.matched()
    assert rig.label == "unconfigured"
    assert rig.call("home").message == "waiting for the driver to be activated"
    for drive in rig.peer.drives:
        drive.silent = True
    assert not rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.label == "unconfigured"
    for drive in rig.peer.drives:
        drive.silent = False
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.label == "inactive"


def waiting_for_a_drive(make_rig: Make) -> Rig:
    rig = make_rig()
    rig.peer.drives[1].silent = True
    rig.matched()
    rig.until(lambda: "node 2 does not answer" in rig.call("home").message, "a name")
    return rig


def test_drives_that_come_later_are_waited_for(make_rig: Make) -> None:
    rig = waiting_for_a_drive(make_rig)
    rig.peer.drives[1].silent = False
    rig.until(lambda: rig.partner.status.get("state") == "DISABLED", "configured")


def test_an_emergency_stop_does_not_end_the_search_for_drives(make_rig: Make) -> None:
    rig = waiting_for_a_drive(make_rig)
    rig.partner.estops.publish(Bool(data=True))
    rig.until(lambda: rig.partner.status.get("state") == "ESTOPPED", "the stop")
    rig.peer.drives[1].silent = False
    rig.until(lambda: "still pressed" in rig.call("reset").message, "the drives")
    rig.partner.estops.publish(Bool(data=False))
    rig.until(lambda: rig.call("reset").success, "the reset")
    rig.until(lambda: rig.partner.status.get("state") == "DISABLED", "configured")


def test_who_configures_it_meanwhile_has_it_watched_all_the_same(make_rig: Make) -> None:
    rig = waiting_for_a_drive(make_rig)
    rig.driver._component.search_after(math.inf)
    rig.peer.drives[1].silent = False
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    assert rig.transition(Transition.TRANSITION_ACTIVATE)
    rig.peer.drives[1].silent = True
    rig.until(lambda: rig.partner.status.get("state") == "FAULT", "the lost drive")


def test_between_words_on_what_the_drives_lack_their_watchdogs_are_fed(
    make_rig: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(autostart=False)
    for drive in rig.peer.drives:
        drive.missing_objects = {0x605B, 0x605C, 0x6083}
    sent: list[int] = []
    logger = rig.driver.get_logger()
    said = logger.warning

    def warning(text: str, **more: Any) -> bool:
        sent.append(rig.driver._component.link.frames_sent)
        return bool(said(text, **more))

    monkeypatch.setattr(logger, "warning", warning)
    monkeypatch.setattr(rig.driver, "get_logger", lambda: logger)
    rig.until(rig.partner.change.service_is_ready, "the driver")
    assert rig.transition(Transition.TRANSITION_CONFIGURE)
    assert len(sent) == 6
    assert len(set(sent)) == 6, "a heartbeat before each"


def test_drives_that_do_not_come_are_named(make_rig: Make) -> None:
    rig = make_rig(connect_timeout=0.0)
    rig.peer.drives[0].silent = True
    with pytest.raises(UserError, match="insertion axis: node 1 does not answer"):
        rig.until(lambda: False, "the end of patience")


def test_on_a_steady_clock_the_driver_sends_its_own_cycles(make_rig: Make) -> None:
    rig = make_rig(use_sim_time=False)
    rig.until(lambda: len(rig.partner.joints) > 5, "joints")
    stamps = [to_nanoseconds(message.header.stamp) for message in rig.partner.joints]
    assert stamps == sorted(stamps)
    assert rig.peer.syncs >= len(stamps)


def test_services_wait_for_the_recorder_where_they_shall(make_rig: Make) -> None:
    rig = make_rig(wait_for_recorder=True)
    rig.matched()
    rig.until(
        lambda: (
            "recorder of" in rig.call("home").message
            and rig.call("home").message.startswith("waiting for")
        ),
        "the recorder",
    )


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"lock_step": True, "use_sim_time": False}, "lock_step wants use_sim_time"),
        ({"insertion_count_per_unit": 1.0}, "did you mean 'insertion_counts_per_unit'"),
        ({"max_speed": 0.006}, "max_speed = 0.006"),
        ({"rotation_node_id": 1}, "the same"),
        ({"lock_step": False, "watchdog": 0.6}, "watchdog = 0.6 s is outside"),
        ({"lock_step": False, "reply_age_limit": 0.6}, "reply_age_limit = 0.6 s is outside"),
    ],
)
def test_bad_parameters_are_refused(make_rig: Make, parameters: dict[str, Any], text: str) -> None:
    with pytest.raises(UserError, match=text):
        make_rig(**parameters)


@pytest.fixture
def domain() -> Iterator[int]:
    with own_domain() as domain:
        yield domain


def test_the_executable_says_in_one_line_what_is_missing_and_ends_on_a_signal(domain: int) -> None:
    command = [sys.executable, "-m", "needle_device_driver.ros.device_driver", "--ros-args"]
    command += ["-p", "channel:=/dev/there-is-none"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    missing = subprocess.run(
        [*command, "-p", "connect_timeout:=0.0"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert missing.returncode == 2
    errors = [line for line in missing.stderr.splitlines() if line.startswith("error: ")]
    assert errors == [
        "error: /device_driver: cannot open slcan /dev/there-is-none: No such file or directory"
    ]
    assert "Traceback" not in missing.stderr
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "looking for the drives" in process.stderr.readline()
        assert "waiting for the drives" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
