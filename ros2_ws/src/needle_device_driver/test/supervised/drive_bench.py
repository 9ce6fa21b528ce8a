"""A supervisor on two scripted drives behind a CAN bus."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from needle_core.can_frame import CanFrame
from needle_device_driver.cia402.backend import Cia402Drives, drive_settings
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.parameters import AXES, DeviceDriverParameters
from needle_device_driver.procedure import Procedure, T, run
from needle_device_driver.supervisor.supervisor import MotionSupervisor

from .scripted_drives import ScriptedDrive
from .supervisor_bench import PERIOD, SupervisorBench

# Counts per radian of the rotation drive.
RAD = 65536 / 6.283185307179586
_FRAME_TIME = 0.0005


class ScriptedBus(FrameLink):
    """A link to scripted drives in virtual time; answers arrive while a frame is sent.

    Attributes
    ----------
    sent : list
        COB-ID and data of each frame that the driver sent.
    late : bool
        Whether answers wait for the next `flush`.
    fault : str
        Why the adapter does not send; empty: it sends.
    absent : bool
        Whether there is no adapter.
    """

    def __init__(self, name: str, bench: DriveBench) -> None:
        self._bench = bench
        self.sent: list[tuple[int, bytes]] = []
        self.late = self.absent = False
        self.fault = ""
        super().__init__(name)

    @property
    def now(self) -> float:
        return self._bench.now

    @now.setter
    def now(self, value: float) -> None:
        """Ignore the time that a component sets."""

    def open(self) -> None:
        if not self.is_open:
            self.set_port_error("no such file" if self.absent else "")
            super().open()
            self.fault = ""

    def send(self, cob_id: int, data: bytes = b"") -> None:
        super().send(cob_id, data)
        self.pop_outgoing()
        if self.fault:
            self.set_port_error(self.fault)
            return
        self._bench.now += _FRAME_TIME + self._bench.sdo_time * (cob_id in (0x601, 0x602))
        self.sent.append((cob_id, data))
        for drive in self._bench.scripts:
            drive.receive(cob_id, data)
        if not self.late:
            self.flush()

    def flush(self) -> None:
        for drive in self._bench.scripts:
            out, drive.out = drive.out, []
            for cob_id, data in out:
                self.put(cob_id, data)

    def put(self, cob_id: int, data: bytes) -> None:
        """Receive a frame."""
        self.receive([CanFrame(cob_id, data)])


class DriveBench(SupervisorBench):
    """Driver and supervisor on two scripted drives, with virtual time."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__()
        self.scripts = self.insertion, self.rotation = ScriptedDrive(1), ScriptedDrive(2)
        # Duration of an SDO transfer [s].
        self.sdo_time = 0.0
        settings = DeviceDriverParameters(link="virtual", channel="test", **parameters)
        self.bus = ScriptedBus(settings.link_name, self)
        self.axes = [
            Cia402Axis(name, drive_settings(settings, name), self.bus, settings.watchdog)
            for name in AXES
        ]
        self.drives = Cia402Drives(self.bus, self.axes, settings.watchdog)
        insertion, rotation = self.axes
        self.supervisor = MotionSupervisor(insertion, rotation, settings, feedback_delay=1)

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end; unfulfilled waits take their full time."""

        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            self.now += 0.0 if is_there() else seconds

        return run(procedure, wait, lambda: self.now)

    def exchange(self) -> None:
        self.drives.collect()
        self.supervisor.drive(PERIOD, self.now)
        # Immediate answers arrive while the frame is sent.
        self.run(self.drives.exchange(0.0))
        self.supervisor.observe(self.now)

    @property
    def positions(self) -> tuple[int, int]:
        return self.insertion.position, self.rotation.position

    @property
    def set_points(self) -> tuple[float, float]:
        insertion, rotation = (axis.poll(self.now).set_point for axis in self.axes)
        return insertion, rotation

    # ---- states of the rig ----------------------------------------------------------------------

    def refusal(self) -> str:
        """Check that the set-up is refused without switching on; return the reason."""
        reply = self.configure()
        assert not reply.success
        assert not [data for cob, data in self.bus.sent if cob in (0x201, 0x202) and data[0] == 15]
        return reply.message

    def configured(self) -> DriveBench:
        reply = self.configure()
        assert reply.success, reply.message
        self.wait(2)
        return self

    def homing(self) -> DriveBench:
        """Begin to home."""
        self.configured()
        assert self.home().success
        return self

    def homed(self) -> DriveBench:
        self.homing()
        self.wait(30)
        assert self.is_homed()
        assert self.state == "DISABLED"
        return self

    def enabled(self) -> None:
        assert self.enable().success
        self.wait(12)
        self.press()
        self.go()

    def ready(self) -> DriveBench:
        """Home, enable and press the hold."""
        self.homed()
        self.enabled()
        return self

    def moving(self) -> DriveBench:
        """Begin a step of 2 mm and 0.2 rad in 1 s."""
        self.ready()
        self.step(0.002, 0.2, 1.0)
        self.go(10)
        assert self.state == "MOVING"
        assert self.insertion.position > 0
        return self

    def after(self, event: Callable[[], None]) -> None:
        """Change a drive, and run the next cycle."""
        event()
        self.bus.flush()
        self.go()

    # ---- checks -------------------------------------------------------------------------------

    def failed(self, rule: str, text: str) -> None:
        """Check that the device is in FAULT by a rule, and nothing moves."""
        assert self.state == "FAULT"
        assert self.rule == rule
        assert text in self.status.fault
        at = self.positions
        self.go(10)
        assert self.positions == at
        assert self.state == "FAULT"

    def stopped(self, rule: str, text: str) -> None:
        """Check that the step failed by a rule, and only a new one moves."""
        assert self.outcomes[-1].startswith("aborted: ")
        self.failed(rule, text)
        at = self.positions
        self.hold(False)
        reply = self.reset()
        assert reply.success, reply.message
        self.wait(10)
        assert self.state == "DISABLED"
        self.enabled()
        self.go(3)
        assert self.positions == at
        self.steps()

    def steps(self) -> None:
        """Move one step, from any state, and check its end."""
        if self.state == "UNCONFIGURED":
            self.ready()
        at = self.positions
        self.step(0.001, 0.3)
        self.go(45)
        assert self.outcomes[-1] == "succeeded"
        assert self.positions[0] - at[0] == 20_000 * self.axes[0]._settings.direction
