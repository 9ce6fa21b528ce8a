"""Paths: several points, replaced without a stop, at rest at their end; named as in safety.md."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import Command, CommandPoint
from needle_device_driver.supervisor.states import State

from ..checks import in_state, refused
from ..ideal_axes import Bench

NAMES = ("insertion_joint", "rotation_joint")
SPEED = 0.005


def path(
    bench: Bench,
    *knots: tuple[float, float],
    speed: float = SPEED,
    stamp_ns: int | None = None,
) -> int:
    """Submit a path through knots (insertion [mm], rotation [rad]); return its stamp."""
    stamp = bench.ros_ns if stamp_ns is None else stamp_ns
    points = tuple(
        CommandPoint((mm * 1e-3, rad), (), (mm - knots[0][0]) * 1e-3 / speed) for mm, rad in knots
    )
    bench.supervisor.submit(Command(stamp, NAMES, points), bench.now)
    return stamp


def test_coordinated_a_path_is_gone_through_its_knots_at_its_speed(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (1.0, 0.3), (2.0, 0.1))
    places = [bench.positions]
    while in_state(bench, State.MOVING):
        bench.cycle(holding=True)
        places.append(bench.positions)
    insertion, rotation = np.array(places).T
    np.testing.assert_allclose(
        rotation, np.interp(insertion, [0.0, 0.001, 0.002], [0.0, 0.3, 0.1]), atol=1e-12
    )
    assert np.diff(insertion)[:-1] == pytest.approx(SPEED * bench.period)
    assert bench.positions == (0.002, 0.1)
    assert [result.outcome for result in bench.results] == ["succeeded"]


def test_coordinated_a_path_takes_the_place_of_another_without_a_stop(bench: Bench) -> None:
    bench.ready()
    first = path(bench, (0.0, 0.0), (1.0, 0.3), (2.0, 0.3))
    bench.cycle(4, holding=True)
    here = bench.positions[0] * 1e3
    second = path(bench, (0.1, 0.0), (1.1, -0.2), (here + 2.0, -0.2))
    before = bench.positions
    bench.cycle(holding=True)
    assert bench.positions[0] - before[0] == pytest.approx(SPEED * bench.period)
    while bench.positions[0] < 0.0011:
        bench.cycle(holding=True)
    assert bench.positions[1] == pytest.approx(-0.2)
    while in_state(bench, State.MOVING):
        bench.cycle(holding=True)
    assert [(result.stamp_ns, result.outcome) for result in bench.results] == [
        (first, "replaced"),
        (second, "succeeded"),
    ]


def test_forward_only_a_path_that_ends_where_the_needle_is_moves_nothing(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (0.5, 0.1), (1.0, 0.1))
    bench.cycle(12, holding=True)
    at = bench.positions
    stamp = path(bench, (0.0, 0.0), (0.5, 0.5), (1.0, 0.5))
    bench.cycle(5, holding=True)
    assert bench.positions == at == (0.001, 0.1)
    assert (bench.results[-1].stamp_ns, bench.results[-1].outcome) == (stamp, "succeeded")


def test_max_rotation_rate_where_rotation_cannot_follow_insertion_waits(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (1.0, 0.5), (2.0, 0.5))
    bench.cycle(9, holding=True)
    # What is left of the first leg, 0.1 mm, is now to be 0.9 rad away.
    path(bench, (0.9, 0.45), (1.0, 0.46), (1.5, 0.46), stamp_ns=bench.ros_ns)
    bench.cycle(holding=True)
    path(bench, (0.8, -0.4), (1.05, -0.42), (2.0, -0.42))
    rates, speeds = [], []
    for _ in range(5):
        before = bench.positions
        bench.cycle(holding=True)
        rates.append(abs(bench.positions[1] - before[1]) / bench.period)
        speeds.append((bench.positions[0] - before[0]) / bench.period)
    assert max(rates) <= bench.limits.max_rotation_rate * (1 + 1e-9)
    assert max(speeds) < 0.5 * SPEED
    assert bench.results[-1].outcome == "replaced"


def test_command_state_a_step_never_takes_the_place_of_a_path_nor_a_path_of_a_step(
    bench: Bench,
) -> None:
    bench.ready()
    bench.command()
    bench.cycle(2, holding=True)
    path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    assert bench.last_rule is Rule.COMMAND_STATE
    bench.cycle(30, holding=True)
    path(bench, (1.0, 0.1), (2.0, 0.1), (3.0, 0.1))
    bench.cycle(2, holding=True)
    stamp = bench.command()
    refusal = bench.results[-1]
    assert (refusal.stamp_ns, refusal.outcome) == (
        stamp,
        "aborted: the device is MOVING, not HOLDING",
    )
    assert in_state(bench, State.MOVING)


def test_max_step_length_bounds_how_far_ahead_a_path_ends(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (1.0, 0.0), (2.006, 0.0))
    refused(bench, Rule.MAX_STEP_LENGTH)


def test_max_step_length_takes_a_path_from_where_the_axes_rest_beside_their_set_points(
    bench: Bench,
) -> None:
    bench.ready()
    rest = bench.limits.insertion_tolerance * 1e3
    path(bench, (rest, 0.0), (1.0 + rest, 0.0), (2.0 + rest, 0.0))
    assert in_state(bench, State.MOVING)


def test_max_step_length_no_path_outlives_its_commands_by_more(bench: Bench) -> None:
    bench.ready()
    for _ in range(20):
        here = bench.positions[0] * 1e3
        path(bench, (here, 0.0), (here + 1.0, 0.0), (here + 2.0, 0.0))
        bench.cycle(2, holding=True)
    last = bench.positions[0]
    bench.cycle(200, holding=True)
    assert bench.positions[0] - last <= bench.limits.max_step_length
    assert bench.results[-1].outcome == "succeeded"
    assert in_state(bench, State.HOLDING)


def test_tip_age_a_slow_path_ends_when_its_tip_is_too_old(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    began = bench.now
    while in_state(bench, State.MOVING):
        bench.cycle(holding=True, scale=0.05)
    assert bench.now - began == pytest.approx(bench.limits.tip_age_limit, abs=3 * bench.period)
    assert bench.last_rule is Rule.TIP_AGE
    assert "the tip behind the path" in bench.results[-1].outcome
    at = bench.positions
    bench.cycle(20, holding=True)
    assert bench.positions == at


@pytest.mark.parametrize("back", [0.3, 3600.0])
def test_tip_age_a_path_ends_when_time_is_set_back(bench: Bench, back: float) -> None:
    bench.ready()
    bench.cycle(20)
    bench.hold(False)
    bench.hold()
    path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    bench.cycle(5, holding=True)
    bench.ros_ns -= round(back * 1e9)
    bench.cycle(2, holding=True)
    assert in_state(bench, State.HOLDING)
    assert bench.last_rule is Rule.TIP_AGE
    assert "ahead of this computer's clock" in bench.results[-1].outcome
    at = bench.positions
    bench.cycle(20, holding=True)
    assert bench.positions == at


def test_tip_age_a_path_goes_on_at_any_speed_while_fresh_ones_come(bench: Bench) -> None:
    bench.ready()
    for _ in range(100):
        here = bench.positions[0] * 1e3
        path(bench, (here, 0.0), (here + 1.0, 0.0), (here + 1.9, 0.0))
        bench.cycle(2, holding=True, scale=0.05)
    assert in_state(bench, State.MOVING)
    assert bench.positions[0] == pytest.approx(100 * 2 * bench.period * 0.05 * SPEED)


@pytest.mark.parametrize(
    ("knots", "rule"),
    [
        (((0.0, 0.0), (1.0, 0.0), (0.9, 0.0)), Rule.COMMAND_FORM),
        (((0.0, 0.0), (0.5, 0.4), (0.6, 1.1)), Rule.MAX_ROTATION_RATE),
        (((-3.0, 0.0), (-2.0, 0.0), (-1.0, 0.0)), Rule.FORWARD_ONLY),
    ],
)
def test_command_form_and_bounds_of_a_path(
    bench: Bench, knots: tuple[tuple[float, float], ...], rule: Rule
) -> None:
    bench.ready()
    path(bench, *knots)
    refused(bench, rule)


def test_forward_only_each_point_is_ahead_of_the_one_before(bench: Bench) -> None:
    bench.ready()
    points = (
        CommandPoint((0.0, 0.0), (), 0.0),
        CommandPoint((0.001, 0.0), (), 0.2),
        CommandPoint((0.0009, 0.0), (), 0.4),
        CommandPoint((0.0015, 0.0), (), 0.6),
    )
    bench.supervisor.submit(Command(bench.ros_ns, NAMES, points), bench.now)
    assert "the point before" in refused(bench, Rule.FORWARD_ONLY)


@pytest.mark.parametrize("ahead", [0.0011, 0.1, 0.5, 1.0])
def test_command_form_a_path_that_begins_ahead_of_the_needle_is_refused(
    bench: Bench, ahead: float
) -> None:
    bench.ready()
    path(bench, (ahead, 0.0), (1.1, 0.1), (1.5, 0.1))
    assert f"begins at {ahead:.6g} mm, ahead of the" in refused(bench, Rule.COMMAND_FORM)


def test_command_form_no_path_that_begins_ahead_takes_the_place_of_another(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (1.0, 0.3), (2.0, 0.3))
    bench.cycle(4, holding=True)
    path(bench, (0.5, 0.1), (1.0, 0.3), (2.2, 0.3))
    bench.cycle(20, holding=True)
    assert (bench.last_rule, bench.positions) == (Rule.COMMAND_FORM, (0.002, 0.3))


def test_command_form_a_path_has_at_most_32_points(bench: Bench) -> None:
    bench.ready()
    path(bench, *((0.01 * k, 0.0) for k in range(33)))
    assert "33 points" in refused(bench, Rule.COMMAND_FORM)


def test_hold_to_run_a_release_ends_a_path_at_once(bench: Bench) -> None:
    bench.ready()
    path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    bench.cycle(3, holding=True)
    at = bench.positions
    bench.hold(False)
    bench.cycle(20)
    assert bench.positions == at
    assert bench.results[-1].outcome == "aborted: hold released"
    path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    bench.cycle(3)
    assert bench.positions == at
    assert bench.last_rule is Rule.HOLD_TO_RUN


def test_hold_age_a_hold_lives_as_long_as_it_says_and_never_longer(bench: Bench) -> None:
    for lifetime, lives in ((0.1, 0.1), (5.0, bench.limits.hold_timeout)):
        bench = Bench()
        bench.ready()
        path(bench, (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
        bench.hold(lifetime=lifetime)
        began = bench.now
        while in_state(bench, State.MOVING):
            bench.cycle()
        assert bench.now - began == pytest.approx(lives, abs=2 * bench.period)
        assert f"limit {lives:g} s" in bench.results[-1].outcome


@pytest.mark.parametrize("lifetime", [0.0, -1.0, float("nan")])
def test_hold_age_a_hold_that_lives_for_no_time_is_a_release(bench: Bench, lifetime: float) -> None:
    bench.ready()
    assert bench.status.hold_owner == "a"
    bench.hold(lifetime=lifetime)
    assert bench.status.hold_owner == ""


def test_coordinated_random_paths_replaced_at_random_keep_every_bound(bench: Bench) -> None:
    rng = np.random.default_rng(7)
    bench.ready()
    places = [bench.positions]
    for _ in range(300):
        insertion, rotation = bench.positions
        here = insertion * 1e3
        turn = rotation + rng.uniform(-0.5, 0.5)
        path(
            bench,
            (here - 0.1, rotation),
            (here + rng.uniform(0.2, 0.9), turn),
            (here + 2.0, turn),
            speed=1e-3,
        )
        scale = rng.uniform(0.0, 1.0)
        for _ in range(rng.integers(1, 4)):
            bench.cycle(holding=True, scale=scale)
            places.append(bench.positions)
    insertion, rotation = np.diff(np.array(places).T)
    assert insertion.min() >= 0.0
    assert insertion.max() <= bench.limits.max_speed * bench.period * (1 + 1e-9)
    assert np.abs(rotation).max() <= bench.limits.max_rotation_rate * bench.period * (1 + 1e-9)
    assert not [
        r for a, b in itertools.pairwise(bench.results) for r in (a, b) if "abort" in r.outcome
    ]


def pushed_bench() -> Bench:
    bench = Bench()
    bench.insertion.actuated = False
    bench.ready()
    return bench


def push(bench: Bench, distance: float) -> None:
    bench.insertion.position += distance
    bench.cycle(holding=True)


def test_coordinated_pushed_by_hand_rotation_follows_the_path_over_the_distance_made() -> None:
    bench = pushed_bench()
    path(bench, (0.0, 0.0), (1.0, 0.3), (2.0, 0.1))
    bench.cycle(holding=True)
    farthest = 0.0
    for distance in (1e-4, 3e-4, -2e-4, 4e-4, 5e-4, 3e-4):
        push(bench, distance)
        bench.cycle(3, holding=True)
        farthest = max(farthest, bench.positions[0])
        wanted = np.interp(farthest, [0.0, 0.001, 0.002], [0.0, 0.3, 0.1])
        assert bench.positions[1] == pytest.approx(wanted)
    assert bench.status.reason == ""


def test_max_rotation_rate_pushed_too_fast_is_said_at_once_and_no_longer_when_it_is_over() -> None:
    bench = pushed_bench()
    path(bench, (0.0, 0.0), (1.0, 0.5), (2.0, 0.5))
    push(bench, 1.5e-3)
    assert bench.status.rotation_owed_rad == pytest.approx(0.5 - np.pi * bench.period)
    assert "pushed too fast: the rotation is 0.44 rad behind" in bench.status.reason
    assert bench.last_rule is Rule.MAX_ROTATION_RATE
    bench.cycle(10, holding=True)
    after = bench.status
    assert after.rotation_owed_rad == 0.0
    assert bench.positions == pytest.approx((1.5e-3, 0.5))
    assert len([notice for notice in bench.notices if "pushed too fast" in notice.text]) == 1


def test_hold_to_run_pushed_by_hand_without_hold_nothing_turns() -> None:
    bench = pushed_bench()
    path(bench, (0.0, 0.0), (1.0, 0.5), (2.0, 0.5))
    push(bench, 2e-4)
    bench.hold(False)
    turned = bench.positions[1]
    bench.insertion.position += 5e-4
    bench.cycle(5)
    assert bench.positions[1] == turned
