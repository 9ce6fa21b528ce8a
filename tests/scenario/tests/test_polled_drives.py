"""Driver on emulated Galil, Zaber and step/direction drives: cases not in the kit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from needle_device_driver.conformance.rig import ConformanceRig
from needle_sim.drives.galil_drives import GalilAxis


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
        *(partial(mixed, drives) for drives in ("galil", "galil,cia402")),
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
