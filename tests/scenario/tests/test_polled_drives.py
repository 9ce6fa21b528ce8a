"""Driver on emulated Galil, Zaber and step/direction drives: cases not in the kit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.conformance.rig import ConformanceRig
from needle_device_driver.rules import Rule
from needle_sim.drives.galil_drives import GalilAxis
from needle_sim.drives.zaber_drives import ZaberDrives


def mixed(drives: str) -> ConformanceRig:
    insertion, rotation = (drives.split(",") * 2)[:2]
    kinds = {"insertion_drive": insertion, "rotation_drive": rotation}
    return ConformanceRig(1, driver=kinds, drives={"drives": drives})


def zaber(*, has_encoder: bool = True, late: float = 0.0) -> ConformanceRig:
    rig = mixed("zaber")
    chain = rig.emulator("insertion")
    for drive in chain.drives.values():
        drive.has_encoder = has_encoder
    chain.late, chain.partial = late, late > 0.0
    return rig


@pytest.mark.parametrize(
    "make",
    [
        *(partial(mixed, drives) for drives in ("galil", "galil,cia402", "cia402,galil")),
        partial(ConformanceRig, 1, axis="stepdir"),
        partial(zaber, has_encoder=False),
        partial(zaber, late=0.015),
    ],
)
def test_a_fast_step_ends_where_it_should(make: Callable[[], ConformanceRig]) -> None:
    rig = make()
    rig.ready()
    stamp = rig.command(0.002, 0.5, 0.41)
    rig.runner.run(0.8)
    assert rig.hand.results[stamp] == "succeeded"
    assert rig.hand.status.simulated
    # The driver sets the home where it observes that the axis has left the switch.
    assert rig.positions == pytest.approx((0.002, 0.5), abs=1e-4)
    assert rig.hand.joints == pytest.approx((0.002, 0.5), abs=2.5e-4)


def test_late_answers_slow_a_step_down() -> None:
    rig = mixed("galil")
    rig.ready()
    rig.late = 0.03
    stamp = rig.command(0.002, 0.5, 0.41)
    rig.runner.run(0.6)
    assert stamp not in rig.hand.results
    rig.runner.run(0.8)
    assert rig.hand.results[stamp] == "succeeded"


def test_each_set_point_is_ordered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = mixed("galil")
    rig.ready()
    targets: list[int] = []
    write = GalilAxis.write

    def record(axis: GalilAxis, name: str, value: int) -> None:
        targets.extend([value] * (name == "PA"))
        write(axis, name, value)

    monkeypatch.setattr(GalilAxis, "write", record)
    rig.command(0.002, 0.0, 0.41)
    rig.runner.run(1.0)
    # The supervisor repeats the last set-point until the axes are at rest.
    assert len(targets) == len(set(targets)) == 21


def test_homing_writes_the_limits_and_set_points_are_bounded() -> None:
    rig = mixed("galil")
    rig.ready()
    registers = rig.emulator("insertion").drives["insertion"].registers
    scale = rig.settings.insertion_counts_per_unit
    assert (registers["FL"] - registers["BL"]) / scale == pytest.approx(0.202, abs=1e-5)
    with pytest.raises(AxisError, match=r"set-point step of 0.00019.* limit") as refused:
        rig.axis("insertion").start_move(0.0002, 0.005)
    assert refused.value.rule is Rule.LOOK_AHEAD


def test_a_drive_that_ignores_a_stop_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = mixed("galil")
    rig.moving()
    for order in ("stop", "motor_off"):
        monkeypatch.setattr(GalilAxis, order, lambda axis: None)
    rig.call("device/stop")
    rig.runner.run(2.0)
    assert "insertion axis still powered" in rig.hand.status.fault


def reboot_at_once(chain: ZaberDrives, now: float) -> None:
    chain.boot_time = 0.0
    chain.reboot("rotation", now)


@pytest.mark.parametrize(
    ("event", "cause"),
    [
        (lambda chain, _: chain.stall("insertion"), "the drive stalled and stopped (FS)"),
        (lambda chain, _: chain.fail("rotation", 1), "supply voltage out of range (FV)"),
        (reboot_at_once, "rotation axis: the drive restarted; its home is lost"),
        (
            lambda chain, _: chain.foreign("/1 1 driver disable"),
            "insertion axis: the drive refused an order: DRIVERDISABLED",
        ),
    ],
    ids=["stall", "voltage", "restart", "another computer"],
)
def test_the_cause_is_named(event: Callable[[Any, float], None], cause: str) -> None:
    rig = zaber()
    rig.moving()
    event(rig.emulator("insertion"), rig.runner.now)
    rig.runner.run(0.4)
    assert cause in rig.hand.status.fault


def test_power_by_another_program_is_a_fault() -> None:
    rig = zaber()
    rig.start()
    rig.emulator("insertion").foreign("/2 1 driver enable")
    assert rig.fails(Rule.ONE_MASTER)
