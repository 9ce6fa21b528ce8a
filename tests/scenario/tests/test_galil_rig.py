"""A whole step on an emulated Galil controller, alone or beside a CiA 402 drive."""

from __future__ import annotations

import pytest

from needle_device_driver.conformance.rig import ConformanceRig
from needle_sim.drives.emulated_drives import AxisState


class GalilRig(ConformanceRig):
    def __init__(self, drives: str) -> None:
        insertion, rotation = (drives.split(",") * 2)[:2]
        kinds = {"insertion_drive": insertion, "rotation_drive": rotation}
        super().__init__(1, driver=kinds, drives={"drives": drives})

    @property
    def motors(self) -> dict[str, AxisState]:
        axes: dict[str, AxisState] = self.drives.axes(self.runner.now)
        return axes

    def begin_step(self) -> tuple[int, float]:
        """Home, and begin a step of 1 mm and 0.5 rad in 1 s; return its stamp and begin."""
        self.home()
        self.press()
        begin = self.hand.joints[0]
        return self.command(begin + 0.001, 0.5, 1.0), begin


@pytest.mark.parametrize("drives", ["galil", "galil,cia402", "cia402,galil"])
def test_a_whole_step(drives: str) -> None:
    rig = GalilRig(drives)
    stamp_ns, begin = rig.begin_step()
    rig.until(lambda: stamp_ns in rig.hand.results, "the step")
    rig.runner.run(0.2)
    assert rig.hand.results[stamp_ns] == "succeeded"
    assert rig.motors["insertion"].position == pytest.approx(begin + 0.001, abs=2e-5)
    assert rig.motors["rotation"].position == pytest.approx(0.5, abs=1e-3)


def test_the_controller_stops_both_axes_when_the_computer_is_cut_off() -> None:
    rig = GalilRig("galil")
    rig.begin_step()
    rig.runner.run(0.5)
    assert rig.motors["insertion"].velocity > 5e-4
    (controller,) = rig.drives.connections.values()
    controller.is_cut = True
    rig.runner.run(0.1)
    assert [axis.velocity for axis in rig.motors.values()] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert controller.states() == {"insertion": "OFF", "rotation": "OFF"}
