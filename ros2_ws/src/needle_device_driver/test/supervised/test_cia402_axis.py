"""A pair of drives on a scripted bus: what goes over the wire, and what the axes make of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.supervisor.states import State

from .drive_bench import DriveBench


def in_state(bench: DriveBench, state: State) -> bool:
    """Return whether the device is in a state, in a way that no type checker remembers."""
    return bool(bench.state is state)


def test_a_step_ends_at_its_target_to_the_count(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.3)
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]
    assert bench.positions == (20_000, round(0.3 * 65536 / 6.283185307179586))
    assert in_state(bench, State.HOLDING)


def test_a_step_right_after_a_release_and_press_waits_for_the_axes(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    # All between two cycles.
    bench.hold(False)
    bench.hold()
    bench.step()
    at = bench.positions
    bench.cycle(2, holding=True)
    assert in_state(bench, State.MOVING)
    assert bench.positions == at
    bench.cycle(40, holding=True)
    assert bench.outcomes == ["aborted: hold released", "succeeded"]


def test_enable_and_home_wait_until_the_axes_are_off(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.supervisor.enable(False, bench.clock())
    bench.supervisor.confirm_needle_out(True)
    for reply in (
        bench.supervisor.enable(True, bench.clock()),
        bench.run(bench.supervisor.home(bench.clock())),
    ):
        assert not reply.success
        assert reply.message.startswith("waiting for")
    bench.cycle(10)
    assert bench.supervisor.enable(True, bench.clock()).success


def test_a_drive_without_transition_16_is_switched_off_and_on_again(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.keeps_quick_stop = True
    bench.hold(False)
    bench.cycle(5)
    bench.hold()
    at = bench.positions
    bench.step()
    bench.cycle(60, holding=True)
    assert bench.outcomes == ["aborted: hold released", "succeeded"]
    assert bench.positions[0] == at[0] + 20_000


def test_a_homing_from_before_does_not_count(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.homed()
    bench.insertion.position, bench.insertion.home_after = 3000, 40
    bench.insertion.stale_homing = True
    bench.insertion.more_status = 0x1400
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.cycle(30)
    assert not bool(bench.status.homed)
    bench.insertion.stale_homing = False
    bench.insertion.more_status = 0
    bench.cycle(30)
    assert bench.status.homed
    assert bench.insertion.position == 0


def test_a_homing_that_nobody_saw_under_way_ends_at_the_switch(drive_bench: DriveBench) -> None:
    """On the edge of its switch a drive is through between two answers."""
    bench = drive_bench
    bench.homed()
    bench.insertion.home_after, bench.insertion.stale_homing = 0, True
    bench.insertion.more_status = 0x1400
    bench.supervisor.confirm_needle_out(True)
    assert bench.run(bench.supervisor.home(bench.clock())).success
    bench.cycle(15)
    assert not bool(bench.status.homed)
    bench.cycle(20)
    assert bench.status.homed


def test_a_homing_where_it_stands_ends_on_a_drive_that_never_takes_its_end_back(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    bench.rotation.stale_homing = True
    bench.rotation.home_after = 0
    bench.supervisor.confirm_needle_out(True)
    bench.run(bench.supervisor.home(bench.clock()))
    bench.cycle(30)
    assert bench.status.homed


def test_a_homing_that_fails_is_a_fault(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    bench.insertion.home_after = 1000
    bench.supervisor.confirm_needle_out(True)
    bench.run(bench.supervisor.home(bench.clock()))
    bench.cycle(6)
    bench.insertion.more_status = 0x2000
    bench.cycle(1)
    assert in_state(bench, State.FAULT)
    assert "homing failed" in bench.status.fault
    assert bench.insertion.state == "quick stop"


def test_a_homing_can_be_stopped_and_leaves_the_axis_un_homed(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    bench.insertion.home_after = 1000
    bench.supervisor.confirm_needle_out(True)
    bench.run(bench.supervisor.home(bench.clock()))
    bench.cycle(6)
    bench.supervisor.stop()
    assert bench.insertion.state == "quick stop"
    bench.cycle(10)
    assert bench.insertion.state == bench.rotation.state == "disabled"
    assert not bench.status.homed
    assert in_state(bench, State.DISABLED)


def test_a_drive_that_does_not_switch_on_is_a_fault_with_its_state(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    bench.rotation.command = lambda word: None  # type: ignore[method-assign]
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(99)
    assert in_state(bench, State.HOLDING)
    bench.cycle(5)
    assert in_state(bench, State.FAULT)
    assert "is not on after 2 s: SWITCH_ON_DISABLED" in bench.status.fault


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({(0x1000, 0): b"\x91\x01\x00\x00"}, "device profile 401, wanted 402"),
        ({(0x6502, 0): b"\x21\x00\x00\x00"}, "no cyclic synchronous position mode"),
        ({(0x6502, 0): b"\x81\x00\x00\x00"}, "no homing mode"),
    ],
)
def test_a_drive_that_lacks_what_is_needed_is_refused(
    drive_bench: DriveBench, change: dict[tuple[int, int], bytes], text: str
) -> None:
    drive_bench.rotation.objects |= change
    drive_bench.rotation.modes = {6}
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert not reply.success
    assert text in reply.message
    assert "rotation axis" in reply.message
    # The other axis waits for nobody's heartbeat.
    assert int.from_bytes(drive_bench.insertion.objects[0x1016, 1], "little") == 0


def test_an_axis_whose_neighbour_is_refused_does_not_wait_for_the_computer(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.rotation.missing_objects = {0x1016}
    assert not bench.run(bench.supervisor.configure(bench.clock())).success
    assert bench.written(1, 0x1016, 1) == bytes(4), "its watchdog is released"
    bench.supervisor.observe(bench.clock())
    assert "node 2 refuses" in bench.status.fault


def test_objects_that_a_drive_may_lack_are_left_out(drive_bench: DriveBench) -> None:
    drive_bench.insertion.missing_objects = {0x1006, 0x1029, 0x6007, 0x60C2}
    assert drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock())).success
    assert [text.partition(":")[0] for text in drive_bench.drives.missing_optional_objects] == [
        "insertion drive has no 0x6007",
        "insertion drive has no 0x60C2",
        "insertion drive has no 0x60C2",
    ]


def test_a_drive_without_digital_inputs_has_no_switch_to_show(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.insertion.missing_objects = {0x60FD}
    bench.insertion.status_size = 3
    bench.ready()
    assert "no digital inputs" in bench.drives.missing_optional_objects[0]
    bench.cycle(1, holding=True)
    bench.step()
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]


def test_an_object_that_a_rule_needs_may_not_be_missing(drive_bench: DriveBench) -> None:
    drive_bench.insertion.missing_objects = {0x1016}
    reply = drive_bench.run(drive_bench.supervisor.configure(drive_bench.clock()))
    assert "refuses to write 0 to 0x1016:1 consumer heartbeat time" in reply.message


def test_a_drive_that_is_not_there_is_named(drive_bench: DriveBench) -> None:
    drive_bench.rotation.silent = True
    why_not = drive_bench.run(drive_bench.drives.probe())
    assert "rotation axis: node 2 does not answer" in why_not


def test_a_drive_that_was_left_on_is_switched_off_by_the_set_up(drive_bench: DriveBench) -> None:
    drive_bench.insertion.state = "enabled"
    drive_bench.configured()
    assert drive_bench.insertion.state == "disabled"


def test_a_torque_bound_is_given_only_where_wanted(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = make_drive_bench(rotation_max_torque=0.8)
    bench.configured()
    assert (0x6072, 0) not in bench.insertion.objects
    assert bench.rotation.objects[0x6072, 0] == (800).to_bytes(2, "little")


def test_an_axis_in_reverse_moves_the_other_way(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = make_drive_bench(insertion_reverse=True)
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.0)
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]
    assert bench.insertion.position == -20_000
    assert bench.status.insertion_m == pytest.approx(0.001)


def test_rotation_stays_in_proportion_when_the_speed_changes(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.002, 1.0, 0.8)
    per_metre = 1.0 / 0.002 * 65536 / 6.283185307179586
    for scale in (1.0, 0.2, 0.7, 0.05, 1.0) * 20:
        bench.cycle(1, holding=True, scale=scale)
        insertion, rotation = bench.insertion.next_target, bench.rotation.next_target
        assert abs(rotation - insertion / 20e6 * per_metre) <= 1.0
    assert bench.outcomes == ["succeeded"]


def test_many_steps_end_where_their_sum_is_to_the_count(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    # `scripts/verify D` takes 10,000, on the emulator.
    bench = make_drive_bench(max_step_length=0.002)
    bench.ready()
    insertion = rotation = 0.0
    for k in range(100):
        insertion += 0.0003 + 0.0004 * (k % 7) / 7
        rotation += 0.2 * (-1) ** (k // 3) * (k % 5) / 5
        bench.cycle(1, holding=True)
        bench.supervisor.submit(
            bench.command(insertion, rotation, bench.ros_ns, 0.15), bench.clock()
        )
        bench.cycle(11, holding=True)
    assert bench.outcomes == ["succeeded"] * 100
    assert bench.positions == (
        round(insertion * 20e6),
        round(rotation * 65536 / 6.283185307179586),
    )


# ---- an insertion axis that a hand pushes ------------------------------------------------------


def pushed(make_drive_bench: Callable[..., DriveBench]) -> DriveBench:
    bench = make_drive_bench(insertion_drive="hand")
    bench.insertion.position = 777
    bench.ready()
    return bench


def push(bench: DriveBench, counts: int) -> None:
    bench.insertion.position += counts
    bench.cycle(1, holding=True)


def test_a_pushed_axis_is_told_nothing_that_moves(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = pushed(make_drive_bench)
    assert bench.status.insertion_m == pytest.approx(0.0)
    bench.step(0.001, 0.2)
    push(bench, 5000)
    bench.hold(False)
    assert not [cob for cob, _ in bench.bus.sent if cob in (0x201, 0x301)]
    assert (0x605A, 0) not in bench.insertion.objects
    # Nor does it depend on the computer.
    assert bench.insertion.objects[0x1016, 1] == bytes(4)


def test_with_a_pushed_axis_rotation_follows_the_push_and_never_goes_back(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = pushed(make_drive_bench)
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.2)
    whole = 0.2 * 65536 / 6.283185307179586
    bench.cycle(10, holding=True)
    assert bench.rotation.next_target == 0
    for reached, wanted in ((4000, 0.2), (9000, 0.45), (6000, 0.45), (12_000, 0.6)):
        push(bench, 777 + reached - bench.insertion.position)
        bench.cycle(2, holding=True)
        assert bench.rotation.next_target == pytest.approx(wanted * whole, abs=1)
    assert bench.outcomes == []
    push(bench, 777 + 21_000 - bench.insertion.position)
    bench.cycle(6, holding=True)
    assert bench.outcomes == ["succeeded"]
    assert bench.rotation.position == round(whole)


def test_with_a_pushed_axis_rotation_keeps_its_rate_and_its_hold(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    bench = pushed(make_drive_bench)
    bench.cycle(1, holding=True)
    bench.step(0.001, 1.0)
    push(bench, 20_000)
    at = bench.rotation.position
    push(bench, 0)
    assert bench.rotation.position - at <= 3.1416 * 0.02 * 65536 / 6.283185307179586 + 1
    bench.hold(False)
    assert bench.rotation.state == "quick stop"
    assert bench.outcomes == ["aborted: hold released"]


def test_a_pushed_axis_is_retracted_by_hand(make_drive_bench: Callable[..., DriveBench]) -> None:
    bench = pushed(make_drive_bench)
    bench.cycle(1, holding=True)
    reply = bench.supervisor.retract(bench.clock())
    assert not reply.success
    assert "by hand" in reply.message


def test_an_axis_that_is_not_on_takes_no_set_point(drive_bench: DriveBench) -> None:
    drive_bench.homed()
    with pytest.raises(AxisError, match="not ready to move"):
        drive_bench.axes[0].start_move(0.0, 0.001)


@pytest.mark.parametrize(("inputs", "outer"), [(1, True), (2, False), (4, True), (0, False)])
def test_the_outer_end_is_the_negative_limit_switch_or_the_home_switch(
    drive_bench: DriveBench, inputs: int, outer: bool
) -> None:
    drive_bench.configured()
    drive_bench.insertion.inputs = inputs
    drive_bench.cycle()
    assert drive_bench.axes[0].poll(drive_bench.clock()).at_home_switch is outer
