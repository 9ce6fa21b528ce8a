"""A supervisor on two scripted drives behind a CAN bus."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from needle_device_driver.cia402.backend import Cia402Drives, drive_settings
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.procedure import Procedure, T, run
from needle_device_driver.supervisor.supervisor import MotionSupervisor

from .scripted_drives import ScriptedBus, ScriptedDrive
from .supervisor_bench import PERIOD, SupervisorBench

# Counts per radian of the rotation drive.
RAD = 65536 / 6.283185307179586
_FRAME_TIME = 0.0005


class BenchLink(FrameLink):
    """A link with virtual time; answers arrive while a frame is sent."""

    def __init__(self, name: str, bench: DriveBench) -> None:
        self._bench = bench
        super().__init__(name)

    @property
    def now(self) -> float:
        return self._bench.now

    @now.setter
    def now(self, value: float) -> None:
        """Ignore the time that a component sets."""

    def open(self) -> None:
        if not self.is_open:
            self.set_port_error("no such file" if self._bench.no_adapter else "")
            super().open()
            self._bench.broken = ""

    def send(self, cob_id: int, data: bytes = b"") -> None:
        super().send(cob_id, data)
        self.pop_outgoing()
        if self._bench.broken:
            self.set_port_error(self._bench.broken)
            return
        self._bench.now += _FRAME_TIME + self._bench.sdo_time * (cob_id in (0x601, 0x602))
        self._bench.bus.send(cob_id, data)


class DriveBench(SupervisorBench):
    """Driver and supervisor on two scripted drives, with virtual time."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__()
        self.insertion, self.rotation = ScriptedDrive(1), ScriptedDrive(2)
        self.no_adapter = False
        # Why the adapter does not send; empty: it sends. Duration of an SDO transfer [s].
        self.broken = ""
        self.sdo_time = 0.0
        self.settings = DeviceDriverParameters(link="virtual", channel="test", **parameters)
        self.link = BenchLink(self.settings.link_name, self)
        self.bus = ScriptedBus([self.insertion, self.rotation], lambda f: self.link.receive([f]))
        watchdog = self.settings.watchdog
        self.axes = [
            Cia402Axis(
                name,
                drive_settings(self.settings, name),
                self.link,
                watchdog=watchdog,
            )
            for name in ("insertion", "rotation")
        ]
        self.drives = Cia402Drives(self.link, self.axes, watchdog)
        self.supervisor = MotionSupervisor(
            self.axes[0],
            self.axes[1],
            self.settings,
            feedback_delay=1,
        )

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

    def joint(self, number: int = 0) -> float:
        """Return the last set-point of a joint."""
        return self.axes[number].poll(self.now).set_point

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

    def step(self, length: float = 0.001, rotation: float = 0.1, duration: float = 0.5) -> None:
        joints = self.supervisor.joints(self.now)
        assert joints is not None
        at = joints.insertion.position, joints.rotation.position
        self.submit((at[0] + length, at[1] + rotation, duration))

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

    def delay_reaction(self, drive: ScriptedDrive, seconds: float) -> None:
        """Delay the reaction of a drive to a command by some time [s]; then the drive is off."""
        due = math.inf

        def command(word: int) -> None:
            nonlocal due
            drive.last_word, due = word, self.now + seconds

        def sending() -> None:
            if self.now >= due:
                drive.state = "disabled"

        drive.command, self.bus.sending = command, sending  # type: ignore[method-assign]

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
