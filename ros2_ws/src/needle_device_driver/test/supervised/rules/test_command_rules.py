"""Rules for commands, named as in docs/safety.md."""

from __future__ import annotations

import math

import pytest

from needle_core.messages import Trajectory, TrajectoryPoint
from needle_device_driver.supervisor.command import check_form

from ..ideal_axes import Bench
from ..supervisor_bench import NAMES, PERIOD, rejected

MS = 1_000_000
Point = tuple[float, float, float]


# ---- state --------------------------------------------------------------------------------------


def test_command_state_requires_holding_and_power() -> None:
    bench = Bench().homed()
    bench.step()
    assert bench.rule == "command_state"
    assert "DISABLED" in bench.outcomes[-1]
    bench = Bench().ready()
    bench.rotation.powered = False
    bench.step()
    assert bench.outcomes == ["aborted: the axes are not powered yet"]
    assert (bench.rule, bench.state) == ("command_state", "HOLDING")
    assert bench.status.commands_refused == 1


def test_command_state_second_command_does_not_affect_the_step() -> None:
    bench = Bench().ready()
    stamp = bench.step()
    bench.go(5)
    other = bench.step(0.002, 1.0)
    # With its own stamp, the result would mean the end of the running step.
    bench.step(0.002, 1.0, stamp_ns=int(str(stamp)))
    assert bench.reset() == rejected("a step is under way")
    bench.go(20)
    refusal = "aborted: the device is MOVING, not HOLDING"
    assert bench.results == [(other, refusal), (stamp, "succeeded")]
    assert bench.positions == (0.001, 0.1)


@pytest.mark.parametrize("which", ["insertion", "rotation"])
def test_reply_age_no_step_begins_with_a_silent_axis(which: str) -> None:
    bench = Bench().ready()
    bench.axis(which).silent_since = bench.now - 0.101
    bench.step()
    assert (bench.rule, bench.state) == ("reply_age", "HOLDING")
    bench.axis(which).silent_since = bench.now - 0.099
    bench.step()
    assert bench.state == "MOVING"


def test_inner_limit_switch_ends_a_step_and_none_begins_there() -> None:
    bench = Bench().ready()
    bench.insertion.inner_switch = True
    bench.step()
    assert (bench.rule, bench.state) == ("inner_limit_switch", "HOLDING")
    bench = Bench().moving()
    bench.insertion.inner_switch = True
    at = bench.positions
    bench.go()
    assert (bench.rule, bench.state, bench.positions) == ("inner_limit_switch", "FAULT", at)


def test_command_one_publisher() -> None:
    bench = Bench().ready()
    bench.step(publishers=2)
    assert "2 nodes" in bench.refused("command_one_publisher")
    # A publisher may not have been discovered yet.
    bench.step(publishers=0)
    assert bench.state == "MOVING"


def test_homed_first() -> None:
    bench = Bench()
    bench.configure()
    bench.enable()
    bench.hold()
    bench.step()
    bench.refused("homed_first")


# ---- form ---------------------------------------------------------------------------------------


def form(names: tuple[str, ...], *points: TrajectoryPoint) -> tuple[str, str]:
    refusal = check_form(Trajectory(1, names, points))
    return ("", "") if refusal is None else (refusal.rule.value, refusal.text)


def test_command_form() -> None:
    def point(*positions: float, time: float = 0.5) -> TrajectoryPoint:
        return TrajectoryPoint(positions, time)

    good = point(0.001, 0.1)
    fine = "", ""
    assert form(NAMES, good) == form(NAMES[::-1], good) == fine
    assert form(NAMES, point(1.0, 1.0, time=600.0)) == fine
    path = [point(0.0, 0.0, time=float(number)) for number in range(33)]
    assert form(NAMES, *path[:32]) == fine
    order = "time_from_start does not increase from point to point"
    for names, points, text in (
        ((NAMES[0], NAMES[0]), [good], f"joints {NAMES[0]}, {NAMES[0]}, expected {NAMES[0]}, "),
        ((*NAMES, NAMES[0]), [point(0.001, 0.1, 0.001)], "joints "),
        (NAMES, [], "0 points, expected 1 to 32"),
        (NAMES, path, "33 points, expected 1 to 32"),
        (NAMES, [good, good], order),
        (NAMES, [good, point(0.002, 0.1, time=0.4)], order),
        (NAMES, [point(0.001)], "1 positions, expected 2"),
        (NAMES, [point(0.001, 0.1, 0.1)], "3 positions, expected 2"),
        (NAMES, [point(0.001, 0.1, time=0.0)], "time_from_start 0 s, expected > 0 s and at most"),
        (NAMES, [point(0.001, 0.1, time=-0.5), good], "time_from_start -0.5 s"),
        (NAMES, [good, point(0.002, 0.1, time=600.001)], "time_from_start 600.001 s"),
    ):
        rule, found = form(names, *points)
        assert (rule, found[: len(text)]) == ("command_form", text)


def test_command_form_joints_have_any_order() -> None:
    bench = Bench().ready()
    points = (TrajectoryPoint((0.1, 0.001), 0.5),)
    bench.supervisor.submit(Trajectory(bench.ros_ns, NAMES[::-1], points), bench.now)
    bench.go(25)
    assert bench.positions == (0.001, 0.1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_command_finite(bad: float) -> None:
    for point in (
        TrajectoryPoint((bad, 0.1), 0.5),
        TrajectoryPoint((0.001, bad), 0.5),
        TrajectoryPoint((0.001, 0.1), 0.5, (0.0, bad)),
        TrajectoryPoint((0.001, 0.1), bad),
    ):
        assert form(NAMES, point)[0] == "command_finite"


# ---- stamps -------------------------------------------------------------------------------------


def test_tip_age_while_ros_time_is_paused() -> None:
    bench = Bench().ready()
    # Longer than the horizon, and more cycles than are kept.
    for _ in range(1500):
        bench.now += PERIOD
        bench.supervisor.note_time(bench.ros_ns, bench.now)
    bench.press()
    bench.step()
    assert "30.000 s old, limit 2 s" in bench.refused("tip_age")


def test_tip_age_unknown_or_from_the_future() -> None:
    for offset_ms, why in (
        (-1000, "inf s old, limit 2 s"),
        (101, "the tip is from the future: its stamp is 0.101 s ahead of this computer's clock"),
    ):
        bench = Bench().ready()
        bench.step(stamp_ns=bench.ros_ns + offset_ms * MS)
        assert why in bench.refused("tip_age")
        assert bench.status.watchdog_trips == 1
    bench = Bench().ready()
    bench.step(stamp_ns=bench.ros_ns + 100 * MS)
    assert bench.state == "MOVING"
    # After ROS time was set back, a stamp may be from before.
    bench = Bench().ready()
    bench.go(20)
    bench.ros_ns -= 200 * MS
    bench.go()
    bench.step(stamp_ns=bench.ros_ns - 50 * MS)
    assert "inf s old" in bench.refused("tip_age")


def test_tip_age_bound_is_two_seconds() -> None:
    for seconds, state in ((1.98, "MOVING"), (2.02, "HOLDING")):
        bench = Bench().ready()
        bench.wait()
        stamp = bench.ros_ns
        bench.wait(round(seconds / 0.02))
        bench.press()
        bench.step(stamp_ns=stamp + 1)
        assert bench.state == state, seconds


# ---- bounds -------------------------------------------------------------------------------------


def bounded(rule: str, text: str, within: Point, beyond: Point, **limits: float) -> None:
    """Check that a step just beyond a bound is refused, and one within is accepted."""
    bench = Bench(**limits).ready()
    bench.submit(beyond)
    assert bench.refused(rule) == f"aborted: {text}"
    bench.submit(within)
    assert bench.state == "MOVING", bench.outcomes


def test_forward_only() -> None:
    bench = Bench().ready()
    bench.step(0.0)
    bench.refused("forward_only")
    bench.step(1e-5)
    assert bench.state == "MOVING"
    bench.go(25)
    bench.submit((2e-6, 0.1, 0.5))
    assert bench.rule == "forward_only"
    assert bench.outcomes[-1] == "aborted: insertion 0.002 mm is not ahead of 0.01 mm"


def test_max_depth() -> None:
    text = "depth 1.50001 mm is beyond 1.5 mm"
    bounded("max_depth", text, (0.0015, 0.0, 0.5), (0.00150001, 0.0, 0.5), max_depth=0.0015)


def test_max_step_length() -> None:
    text = "step 2.00101 mm is beyond 2 mm"
    bounded("max_step_length", text, (0.002001, 0.0, 0.5), (0.00200101, 0.0, 0.5))


def test_max_speed() -> None:
    # With the tolerance of 1 um; a message's time has whole nanoseconds.
    text = "speed 5.00003 mm/s is beyond 5 mm/s"
    bounded("max_speed", text, (0.001001, 0.0, 0.2), (0.001001, 0.0, 0.199_999))


def test_max_rotation_step_counts_from_the_set_point() -> None:
    text = "rotation 1.20011 rad is beyond 1.2 rad"
    bounded("max_rotation_step", text, (0.001, 1.2001, 0.5), (0.001, 1.20011, 0.5))
    bench = Bench().ready()
    bench.step(0.001, 1.0)
    bench.go(25)
    bench.step(0.001, -1.21)
    assert bench.rule == "max_rotation_step"
    bench.step(0.001, 1.0)
    assert bench.state == "MOVING"


def test_max_rotation_rate() -> None:
    time = 1.0 / math.pi
    text = "rotation rate 3.1416 rad/s is beyond 3.14159 rad/s"
    bounded("max_rotation_rate", text, (0.001, -1.0001, time), (0.001, -1.0001, time - 1e-6))


def test_max_turns() -> None:
    for sign in (1, -1):
        turn = sign * 0.1 * 2.0 * math.pi
        text = "accumulated rotation 0.10001 turns is beyond 0.1 turns"
        bounded("max_turns", text, (0.001, turn, 0.5), (0.001, turn * 1.0001, 0.5), max_turns=0.1)
