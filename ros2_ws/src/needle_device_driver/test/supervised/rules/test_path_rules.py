"""Rules for paths, named as in docs/safety.md."""

from __future__ import annotations

import numpy as np
import pytest

from ..ideal_axes import Bench
from ..supervisor_bench import PERIOD, rejected

SPEED = 0.005


def path(bench: Bench, *knots: tuple[float, float], speed: float = SPEED) -> int:
    """Submit a path through knots (insertion [mm], rotation [rad]); return its stamp."""
    begin = knots[0][0]
    return bench.submit(*((mm * 1e-3, rad, (mm - begin) * 1e-3 / speed) for mm, rad in knots))


def straight(bench: Bench) -> int:
    return path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))


def test_coordinated_path_passes_its_knots_at_its_speed() -> None:
    bench = Bench().ready()
    path(bench, (0.0, 0.0), (1.0, 0.3), (2.0, 0.1))
    places = [bench.positions]
    while bench.state == "MOVING":
        bench.go()
        places.append(bench.positions)
    insertion, rotation = np.array(places).T
    wanted = np.interp(insertion, [0.0, 0.001, 0.002], [0.0, 0.3, 0.1])
    np.testing.assert_allclose(rotation, wanted, atol=1e-12)
    assert np.diff(insertion) == pytest.approx([SPEED * PERIOD] * 20)
    assert bench.positions == (0.002, 0.1)
    assert bench.outcomes == ["succeeded"]


def test_coordinated_path_replaces_another_without_a_stop() -> None:
    bench = Bench().ready()
    first = path(bench, (0.0, 0.0), (1.0, 0.3), (2.0, 0.3))
    bench.go(4)
    here = bench.positions[0] * 1e3
    # It begins behind the needle: the rest of its first leg takes proportionally less time.
    second = path(bench, (0.1, 0.0), (1.1, -0.2), (here + 2.0, -0.2))
    before = bench.positions
    bench.go()
    assert bench.positions[0] - before[0] == pytest.approx(SPEED * PERIOD)
    while bench.positions[0] < 0.0011:
        bench.go()
    assert bench.positions[1] == pytest.approx(-0.2)
    while bench.state == "MOVING":
        bench.go()
    assert bench.results == [(first, "replaced"), (second, "succeeded")]


def test_coordinated_path_may_have_a_knot_at_the_needle() -> None:
    bench = Bench().ready()
    straight(bench)
    bench.go(10)
    path(bench, (0.5, 0.0), (1.0, 0.0), (2.0, 0.2))
    bench.go(5)
    assert bench.positions == pytest.approx((0.0015, 0.1))


def test_forward_only_path_that_ends_at_the_needle_moves_nothing() -> None:
    bench = Bench().ready()
    path(bench, (0.0, 0.0), (0.5, 0.1), (1.0, 0.1))
    bench.go(12)
    # Up to the tolerance of the axes.
    stamp = path(bench, (0.0, 0.0), (0.5, 0.5), (1.0009, 0.5))
    bench.go(3)
    assert bench.positions == (0.001, 0.1)
    assert bench.results[-1] == (stamp, "succeeded")
    path(bench, (0.0, 0.0), (0.5, 0.1), (1.0011, 0.1))
    assert bench.state == "MOVING"


def test_max_rotation_rate_slows_the_insertion() -> None:
    bench = Bench().ready()
    path(bench, (0.0, 0.0), (1.0, 0.5), (2.0, 0.5))
    bench.go(10)
    # The rest of the first leg, 0.05 mm, has a rotation of 0.9 rad.
    path(bench, (0.8, -0.4), (1.05, -0.42), (2.0, -0.42))
    for _ in range(5):
        before = bench.positions
        bench.go()
        turned, moved = before[1] - bench.positions[1], bench.positions[0] - before[0]
        assert turned == pytest.approx(np.pi * PERIOD)
        assert moved < 0.5 * SPEED * PERIOD
    assert bench.outcomes[-1] == "replaced"


@pytest.mark.parametrize(
    ("rule", "value", "points"),
    [
        ("forward_only", "before, 1 mm", [(1e-3, 0.0, 0.2), (1e-3, 0.0, 0.4), (2e-3, 0.0, 0.6)]),
        ("forward_only", "before, 1 mm", [(1e-3, 0.0, 0.2), (9e-4, 0.0, 0.4), (2e-3, 0.0, 0.6)]),
        ("max_speed", "5.54444", [(5e-4, 0.0, 0.09), (1e-3, 0.0, 0.3), (1.5e-3, 0.0, 0.5)]),
        ("max_rotation_step", "1.3", [(5e-4, 0.7, 0.3), (1e-3, 1.3, 0.6), (1.5e-3, 0.7, 0.9)]),
        ("max_rotation_rate", "3.4995", [(5e-4, 0.0, 0.1), (1e-3, -0.7, 0.3), (2e-3, -0.7, 0.5)]),
        ("max_turns", "0.111408", [(5e-4, 0.4, 0.3), (1e-3, 0.7, 0.6), (1.5e-3, 0.4, 0.9)]),
        ("max_depth", "1.7", [(1e-3, 0.0, 0.3), (1.7e-3, 0.0, 0.6)]),
        ("max_step_length", "2.1", [(1e-3, 0.0, 0.3), (2.1e-3, 0.0, 0.6)]),
    ],
)
def test_each_piece_of_a_path_is_bounded(
    rule: str, value: str, points: list[tuple[float, float, float]]
) -> None:
    limits = {"max_turns": {"max_turns": 0.1}, "max_depth": {"max_depth": 0.0016}}
    bench = Bench(**limits.get(rule, {})).ready()
    bench.submit(*points)
    assert f" {value}" in bench.refused(rule)


def test_command_state_step_and_path_do_not_replace_each_other() -> None:
    bench = Bench().ready()
    bench.step()
    bench.go(2)
    straight(bench)
    assert bench.rule == "command_state"
    bench.go(30)
    path(bench, (1.0, 0.1), (2.0, 0.1), (3.0, 0.1))
    stamp = bench.step(stamp_ns=bench.ros_ns + 1)
    assert bench.results[-1] == (stamp, "aborted: the device is MOVING, not HOLDING")
    assert bench.state == "MOVING"


def test_tip_age_ends_a_slow_path() -> None:
    bench = Bench().ready()
    straight(bench)
    limit = bench.now + 2.0
    bench.go(99, scale=0.05)
    bench.now = limit
    bench.hold(scale=0.05)
    bench.supervisor.drive(PERIOD, limit)
    assert bench.state == "MOVING"
    bench.supervisor.drive(PERIOD, limit + 1e-9)
    assert (bench.state, bench.rule) == ("HOLDING", "tip_age")
    assert "the tip behind the path is 2.000 s old, limit 2 s" in bench.outcomes[-1]
    assert bench.status.watchdog_trips == 1


def test_tip_age_ends_a_path_when_time_is_set_back() -> None:
    bench = Bench().ready()
    bench.wait(20)
    bench.press()
    straight(bench)
    bench.go(5)
    bench.ros_ns -= 300_000_000
    bench.go(2)
    assert (bench.state, bench.rule) == ("HOLDING", "tip_age")
    assert "ahead of this computer's clock" in bench.outcomes[-1]


def test_tip_age_does_not_end_a_step() -> None:
    bench = Bench().ready()
    bench.step(0.002, 0.0, 3.0)
    bench.go(150)
    assert bench.outcomes == ["succeeded"]


def test_settling_time_restarts_with_a_new_path() -> None:
    bench = Bench().ready()
    for end in (1.0, 2.0):
        path(bench, (0.0, 0.0), (0.5, 0.0), (end, 0.0))
        bench.rotation.stuck, bench.rotation.position = True, 0.001
        bench.go(40)
        assert bench.state == "MOVING", bench.status.fault
    bench.go(22)
    assert (bench.state, bench.rule) == ("FAULT", "settling_time")


def test_command_form_path_must_not_begin_ahead_of_the_needle() -> None:
    bench = Bench().ready()
    path(bench, (0.0011, 0.0), (1.1, 0.1), (1.5, 0.1))
    assert "begins at 0.0011 mm, ahead of the needle at 0 mm" in bench.refused("command_form")
    # Up to the tolerance of the axes.
    path(bench, (0.001, 0.0), (1.1, 0.1), (1.5, 0.1))
    assert bench.state == "MOVING"
    bench.go(5)
    path(bench, (0.6, 0.0), (1.1, 0.1), (1.5, 0.1))
    assert bench.outcomes[-1].endswith("at 0.6 mm, ahead of the needle at 0.5 mm")


# ---- an insertion axis that a hand pushes -------------------------------------------------------


def pushed() -> Bench:
    bench = Bench()
    bench.insertion.actuated = False
    return bench.ready()


def push(bench: Bench, distance: float) -> None:
    bench.insertion.position += distance
    bench.go()


def test_max_rotation_rate_reports_a_fast_push_while_it_lasts() -> None:
    bench = pushed()
    path(bench, (0.0, 0.0), (1.0, 0.5), (2.0, 0.5))
    push(bench, 1.5e-3)
    assert bench.positions[1] == pytest.approx(np.pi * PERIOD)
    assert bench.status.rotation_owed_rad == pytest.approx(0.5 - np.pi * PERIOD)
    assert "pushed too fast: the rotation is 0.44 rad behind" in bench.status.reason
    assert bench.rule == "max_rotation_rate"
    bench.go(10)
    assert bench.status.rotation_owed_rad == 0.0
    assert bench.positions == pytest.approx((1.5e-3, 0.5))
    assert [notice.rule for notice in bench.notices].count(bench.notices[-1].rule) == 1
    push(bench, 5e-4)
    assert (bench.outcomes, "move" in bench.insertion.orders) == (["succeeded"], False)
    by_hand = "the insertion axis is moved by hand: withdraw the needle by hand"
    assert bench.retract() == rejected(by_hand)


def test_hold_to_run_without_hold_a_push_turns_nothing() -> None:
    bench = pushed()
    path(bench, (0.0, 0.0), (1.0, 0.5), (2.0, 0.5))
    bench.go()
    push(bench, 1e-4)
    turned = bench.positions[1]
    bench.insertion.position += 1e-4
    bench.go(2, scale=0.0)
    assert bench.positions[1] == turned
    bench.hold(False)
    bench.insertion.position += 5e-4
    bench.wait(5)
    assert turned == pytest.approx(0.05)
    assert bench.positions[1] == turned
