"""The `drive_emulator` executable: two drives on a bus, as a process of their own."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from needle_core.commands.cli import EXIT_DONE
from needle_core.errors import UserError
from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import DiagnosticsPublisher, executor_of, run_node
from needle_core.ros.conversions import JOINT_STATES, RELIABLE, to_nanoseconds, to_stamp
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_sim.bus.pty_port import PtyPort
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters
from needle_sim.drives.bus_health import bus_health
from needle_sim.drives.drive_server import DriveServer
from needle_sim.drives.emulated_bus import EmulatedBus, MotionClock
from needle_sim.drives.fault_commands import COMMANDS
from needle_sim.drives.power_state import PowerState
from needle_sim.rig.sync_stamps import SyncStamps

HELP = f"""\
drive_emulator: a stepper (insertion) and a servo (rotation) as CiA 402 drives on one CAN bus.

Whatever drives them reaches the bus as through a serial adapter (slcan) at a pseudo-terminal. The
drives know profile position, homing (methods 17, 18, 35, 37) and cyclic synchronous position mode,
software limits, following error, emergencies, heartbeats both ways.

By hand, beside a driver:
    ros2 run needle_sim drive_emulator --ros-args -p pty:=/tmp/can
    ros2 run needle_device_driver device_driver --ros-args -p link:=slcan -p channel:=/tmp/can

Faults on command: type a line into this program's terminal, or write it to its input.
{"".join(f"    {line}" + chr(10) for line in COMMANDS.splitlines())}
Publishes   sim/drive_positions: where the motors really are, from the home switch's edge, whatever
            the drives count; with motion_clock sync one for every SYNC, else 50 Hz
"""

# A look at ROS costs more than serving a frame: not more often than this, where nothing is awaited
# of it.
_WAIT = 0.005
_PERIOD = 0.02
_PATIENCE = 0.2


class DriveEmulatorNode(WholeNode):
    """Runs the drives and tells what their motors did.

    Parameters
    ----------
    node_arguments : dict
        Passed on to rclpy's Node (a context of its own, parameter overrides).
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("drive_emulator", **node_arguments)
        values = NodeParameters(self, DriveEmulatorParameters).values
        clock = MotionClock(values.motion_clock)
        self._steps_with_sync = clock is MotionClock.SYNC
        self._bus = EmulatedBus(values.insertion, values.rotation, clock, time.monotonic())
        self._states = {name: drive.state for name, drive in self._bus.drives.items()}
        self._syncs_seen = 0
        self._stamps = SyncStamps(_PATIENCE)
        self._sim_time = bool(self.get_parameter("use_sim_time").value)
        self._told_at = 0.0
        self._times = self.create_subscription(Clock, "/clock", self._on_clock, RELIABLE)
        self._positions = self.create_publisher(JointState, "sim/drive_positions", JOINT_STATES)
        self._diagnostics = DiagnosticsPublisher(self)
        self._tell_health()
        # Last: what fails before leaves no link behind.
        port = PtyPort(Path(values.pty).expanduser() if values.pty else None)
        self.get_logger().info(f"slcan adapter at {port.path}")
        self._server = DriveServer(self._bus, port)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            "emulates both drives; no motor hangs on them",
            lambda: [] if self._bus.syncs else ["a driver on the bus"],
            alone_on=("sim/drive_positions",),
        )

    def turn(self) -> bool:
        """Serve the bus for a moment.

        Returns
        -------
        bool
            Whether the stamp of the last positions waits for /clock.
        """
        self._server.turn(0.0 if self._stamps.waits else _WAIT)
        now = time.monotonic()
        if self._steps_with_sync:
            self._tell_synced_positions(now)
        elif now - self._told_at >= _PERIOD:
            self._told_at = max(self._told_at + _PERIOD, now - _PERIOD)
            self._tell_positions(self.get_clock().now().nanoseconds)
        self._watch_states()
        return self._stamps.waits

    def obey(self, line: str) -> None:
        """Carry out a fault on command, and say where it came; complain about what is none."""
        axes = self._bus.axes(time.monotonic())
        try:
            self._server.obey(line)
        except UserError as error:
            self.get_logger().error(str(error))
            return
        self.get_logger().warning(
            f"on command: {line.strip()}, at {axes['insertion'].position * 1e3:.6f} mm, "
            f"{axes['rotation'].position:.6f} rad"
        )
        self._tell_health()

    def close(self) -> None:
        """Take the adapter away."""
        self._server.close()

    @property
    def new_times(self) -> int:
        """Number of new simulated times heard since positions were told."""
        return self._stamps.new_times

    def _on_clock(self, message: Clock) -> None:
        self._stamps.hear(to_nanoseconds(message.clock))

    def _tell_synced_positions(self, now: float) -> None:
        """Tell the positions of the last SYNC, with the simulated time that it belongs to."""
        self._stamps.sync(self._bus.syncs - self._syncs_seen, now)
        self._syncs_seen = self._bus.syncs
        # Who sends SYNCs may know of /clock before it is discovered here.
        simulated = self._sim_time or self._times.get_publisher_count() > 0
        stamp_ns = self._stamps.take(now, simulated=simulated)
        if stamp_ns is not None:
            self._tell_positions(stamp_ns or self.get_clock().now().nanoseconds)

    def _tell_positions(self, stamp_ns: int) -> None:
        axes = self._bus.axes(time.monotonic())
        message = JointState(
            name=[f"{name}_joint" for name in axes],
            position=[axis.position for axis in axes.values()],
            velocity=[axis.velocity for axis in axes.values()],
        )
        message.header.stamp = to_stamp(stamp_ns)
        self._positions.publish(message)

    def _watch_states(self) -> None:
        states = {name: drive.state for name, drive in self._bus.drives.items()}
        if states == self._states:
            return
        for name, state in states.items():
            if state is PowerState.FAULT and self._states[name] is not state:
                code = self._bus.drives[name].error_code
                self.get_logger().warning(f"{name} drive: fault 0x{code:04X}")
        self._states = states
        self._tell_health()

    def _tell_health(self) -> None:
        self._diagnostics.set("drives", bus_health(self._bus))


def main() -> int:
    """Run the emulator; returns its exit code."""

    def spin(node: Node, end: EndRequest) -> int:
        assert isinstance(node, DriveEmulatorNode)
        commands = _CommandInput()
        looked_at = 0.0
        with executor_of(node) as executor, contextlib.closing(node):
            while not end.wanted:
                waits = node.turn()
                for line in commands.lines():
                    node.obey(line)
                now = time.monotonic()
                if waits or now - looked_at >= _WAIT:
                    looked_at = now
                    # All that waits counts: a stamp that came late must not be taken twice, and
                    # what is left to the middleware takes memory there. A flood, more than a queue
                    # holds, must not take the bus's time.
                    executor.spin_ready(
                        _WAIT if waits and node.new_times == 0 else 0.0, RELIABLE.depth
                    )
        return EXIT_DONE

    return run_node(
        DriveEmulatorNode,
        help_text=HELP,
        parameters=DriveEmulatorParameters,
        spin=spin,
        shared_memory=False,
    )


class _CommandInput:
    """Lines of this program's input as they come, without waiting for any."""

    def __init__(self) -> None:
        self._open = sys.stdin is not None
        self._rest = b""

    def lines(self) -> list[str]:
        if not self._open or not select.select([sys.stdin], [], [], 0.0)[0]:
            return []
        # What is typed for a shell in front is not for a program in its background.
        if sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp():
            return []
        data = os.read(sys.stdin.fileno(), 4096)
        # An input that has ended is always ready: not looked at any more.
        self._open = bool(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [line.decode(errors="replace") for line in lines if line.strip()]


if __name__ == "__main__":
    sys.exit(main())
