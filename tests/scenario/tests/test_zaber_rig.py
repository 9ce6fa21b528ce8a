"""Driver on emulated Zaber devices: a whole step, and the causes that it names."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.conformance.rig import ConformanceRig
from needle_sim.drives.zaber_drives import ZaberDrives


class ZaberRig(ConformanceRig):
    """Both axes on Zaber devices, with the driver homed and the hold pressed."""

    def __init__(self, *, has_encoder: bool = True, late: float = 0.0) -> None:
        kinds = {"insertion_drive": "zaber", "rotation_drive": "zaber"}
        super().__init__(1, driver=kinds, drives={"drives": "zaber"})
        chain = self.drives.connections["zaber"]
        assert isinstance(chain, ZaberDrives)
        self.chain = chain
        for drive in chain.drives.values():
            drive.has_encoder = has_encoder
        chain.late, chain.partial = late, late > 0.0
        self.ready()


@pytest.mark.parametrize(("has_encoder", "late"), [(False, 0.0), (True, 0.015)])
def test_a_step_ends_where_it_should_on_a_slow_line_too(has_encoder: bool, late: float) -> None:
    rig = ZaberRig(has_encoder=has_encoder, late=late)
    assert rig.hand.status.simulated
    stamp = rig.command(0.002, 0.5, 0.8)
    rig.until(lambda: stamp in rig.hand.results, "the result")
    assert rig.hand.results[stamp] == "succeeded"
    # The home is where the driver finds out that the axis has left the switch.
    assert rig.place == pytest.approx((0.002, 0.5), abs=5e-5)
    # The counts of the rotation axis are 0.1 mrad.
    assert rig.hand.joints == pytest.approx((0.002, 0.5), abs=2.5e-4)


def reboot_at_once(rig: ZaberRig) -> None:
    rig.chain.boot_time = 0.0
    rig.chain.reboot("rotation", rig.runner.now)


@pytest.mark.parametrize(
    ("happens", "cause"),
    [
        (lambda rig: rig.chain.stall("insertion"), "the drive stalled and stopped (FS)"),
        (lambda rig: rig.chain.fail("rotation", 0x3210), "supply voltage out of range (FV)"),
        (reboot_at_once, "rotation axis: the drive restarted; its home is lost"),
        (
            lambda rig: rig.chain.foreign("/1 1 driver disable"),
            "insertion axis: the drive refused an order: DRIVERDISABLED",
        ),
    ],
    ids=["stall", "voltage", "restart", "another computer"],
)
def test_the_cause_is_named_and_both_axes_stop(
    happens: Callable[[ZaberRig], None], cause: str
) -> None:
    rig = ZaberRig()
    rig.command(0.002, 0.5, 0.8)
    rig.runner.run(0.3)
    happens(rig)
    rig.runner.run(0.4)
    place = rig.place
    assert cause in rig.hand.status.fault
    rig.chain.restore(rig.runner.now)
    rig.runner.run(0.5)
    # A blocked axis that is powered springs back to where it was held.
    assert rig.place == pytest.approx(place, abs=1e-6)
