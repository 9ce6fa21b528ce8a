from __future__ import annotations

import math

import pytest

from needle_bags.player.playback import PlaybackClock
from needle_bags.player.player_options import parse_options
from needle_bags.player.replay_names import is_guarded, marks_a_rig, played_name
from needle_core.errors import UserError

SECOND = 1_000_000_000
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOY, POINT = "sensor_msgs/msg/Joy", "geometry_msgs/msg/Point"


def test_the_clock_runs_at_its_rate_also_after_a_change() -> None:
    clock = PlaybackClock(2.0, 10 * SECOND, now=100.0)
    assert clock.time(101.5) == 13 * SECOND
    assert clock.wait(14 * SECOND, 101.5) == pytest.approx(0.5)
    assert clock.wait(12 * SECOND, 101.5) == 0.0
    clock.set_rate(4.0, 102.0)
    assert clock.time(103.0) == 18 * SECOND


def test_a_pause_takes_no_time() -> None:
    clock = PlaybackClock(1.0, 5 * SECOND, now=0.0, paused=True)
    assert clock.time(9.0) == 5 * SECOND
    clock.restart(6 * SECOND, 9.0)
    assert clock.wait(7 * SECOND, 50.0) == math.inf
    clock.pause(False, 60.0)
    assert clock.wait(7 * SECOND, 60.25) == pytest.approx(0.75)
    clock.pause(True, 60.5)
    clock.set_rate(0.5, 61.0)
    clock.pause(False, 70.0)
    assert clock.wait(7 * SECOND, 70.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "type_name"),
    [
        *(("/device/joint_trajectory", ""), ("/bench/device/joint_trajectory", "")),
        *(("/device/hold", ""), ("/device/estop", ""), ("/target_point", POINT)),
        *(("/target_plane", ""), ("/rig/obstacles", "")),
        ("/parameter_events", "rcl_interfaces/msg/ParameterEvent"),
        *(("/somewhere/else", TRAJECTORY), ("/any", JOY)),
        *(("/keys", f"geometry_msgs/msg/{kind}") for kind in ("Twist", "TwistStamped")),
    ],
)
def test_topics_that_control_a_rig_are_played_under_replay(name: str, type_name: str) -> None:
    assert is_guarded(name, type_name)
    assert played_name(name, type_name) == f"/replay{name}"
    assert played_name(f"/replay{name}", type_name) == f"/replay{name}"


def test_other_topics_keep_their_names_unless_a_rig_runs() -> None:
    for name in ("/needle/tip", "/joint_states", "/clock", "/my_target_plane"):
        assert played_name(name, POINT) == name
        assert played_name(name, POINT, alongside_rig=True) == f"/replay{name}"
    assert marks_a_rig("/bench/device/status")
    assert not marks_a_rig("/replay/device/status")


def test_options() -> None:
    assert parse_options(["bag"]).clock is None
    assert parse_options(["bag", "--clock"]).clock == 40.0
    for arguments, cause in {
        "bag --rate 0": "rate = 0 is outside",
        "bag --start 3 --end 3": "--end 3 s is not after --start 3 s",
        "bag --clock 0": "--clock = 0 Hz",
    }.items():
        with pytest.raises(UserError, match=cause):
            parse_options(arguments.split())
