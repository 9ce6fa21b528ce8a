"""The `device_driver` executable: the `device/...` interface on real drives."""

from __future__ import annotations

import contextlib
import gc
import logging
import sys
import time
from collections.abc import Callable
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from needle_core.commands.cli import EXIT_DONE
from needle_core.errors import UserError
from needle_core.process.end_request import EndRequest
from needle_core.process.reach import DISCOVERY, is_open
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, executor_of, run_node
from needle_core.ros.conversions import NANOSECONDS, RELIABLE, to_nanoseconds
from needle_core.ros.discovery import (
    AnsweringNodes,
    one_too_many,
    unheard,
    unpublished,
    unrecorded,
)
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameter_desk import ParameterDesk
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeLifecycleNode
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.cycle_clock import CycleClock, CycleSchedule
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.cia402.drive_identity import are_emulated
from needle_device_driver.link.can_link import CanLink
from needle_device_driver.link.frame_link import LinkError
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.ros.device_interface import DeviceInterface
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

HELP = """\
device_driver: moves the needle's stepper stage and rotation servo, CiA 402 drives on a CAN bus.

Publishes   joint_states (50 Hz), device/status, device/result
Subscribes  device/joint_trajectory, device/hold, device/estop; /clock with use_sim_time
Services    device/{home,retract,stop,reset}, device/{enable,confirm_needle_out}

Nothing moves at start. To move: device/confirm_needle_out true, device/home, device/enable true,
then press the hold and send steps. docs/hardware.md: wiring, adapters, bringing up new drives;
docs/safety.md: every rule that stops or refuses a motion.

It is a lifecycle node: `autostart` (default) configures and activates it, waiting up to
`connect_timeout` for adapter and drives. Ctrl-C stops the axes and switches them off.
Exit code   0 when ended, 2 when the adapter or a drive is missing, or for bad parameters
"""

PARAMETERS = "needle_device_driver.parameters:DeviceDriverParameters"
PERIOD_NS = 20_000_000
PERIOD = PERIOD_NS / NANOSECONDS
# On a running clock the next cycle must come; a simulated one waits for this one's answers.
_REPLY_WAIT = 0.75 * PERIOD
_RETRY = 0.25
_DESK_LOOK = 0.1
# From a signal to the end [s]: a drive that is not off by then is switched off by its own watchdog.
_GRACE = 0.8
_SLACK = 0.1 * PERIOD


class DeviceDriverNode(WholeLifecycleNode):
    """Runs the cycle: set-points, SYNC, answers, supervision.

    Parameters
    ----------
    make_link : callable
        Makes the link to the drives, of its settings and the steady clock.
    node_arguments : dict
        Passed on to rclpy's Node (a context of its own, parameter overrides).
    """

    def __init__(
        self,
        make_link: Callable[[LinkSettings, Callable[[], float]], CanLink] = CanLink,
        **node_arguments: Any,
    ) -> None:
        # A long request would hold the cycle up: `ParameterDesk` answers.
        super().__init__("device_driver", start_parameter_services=False, **node_arguments)
        self._settings = values = NodeParameters(self, DeviceDriverParameters).values
        self._sim_time = bool(self.get_parameter("use_sim_time").value)
        if values.lock_step and not self._sim_time:
            raise UserError(f"{self.get_fully_qualified_name()}: lock_step wants use_sim_time")
        self._link = make_link(values.link_settings, time.monotonic)
        insertion, rotation = (
            Cia402Axis(
                name, values.drive(name), self._link, period=PERIOD, watchdog=values.watchdog
            )
            for name in ("insertion", "rotation")
        )
        self._drives = DriveCycle(self._link, (insertion, rotation))
        self._supervisor = MotionSupervisor(
            insertion,
            rotation,
            values.limits,
            lock_step=values.lock_step,
            path_delay=values.path_delay,
            feedback_delay=1,
            switching=lambda: self._drives.needs_cycles,
            run=self._link.run,
        )
        self._active = False
        self._autostart = values.autostart
        self.ended = False
        self._waiting_for = "the driver to be activated"
        self._refusal = ""
        self._ends_if_refused = False
        self._give_up_at = time.monotonic() + values.connect_timeout
        self._retry_at = time.monotonic() + (DISCOVERY if is_open() else 0.0)
        self._cycle_clock = CycleClock(PERIOD_NS, lock_step=values.lock_step)
        self._schedule = CycleSchedule(PERIOD, _SLACK)
        self._diagnostics = DiagnosticsPublisher(self)
        self._device = DeviceInterface(
            self,
            self._supervisor,
            self._diagnostics,
            simulated=None,
            refuse=self._why_not_ready,
        )
        # rclpy's first line takes a tenth of a second: not once the drives wait for a heartbeat.
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"looking for the drives on {values.link_settings}",
            lambda: self._missing() or unpublished(self, self._sources[1:]),
        )
        self._timer = self.create_timer(PERIOD, self._on_timer, clock=STEADY_CLOCK)
        self.create_timer(1.0, self._tell_health, clock=STEADY_CLOCK)
        self._sources = [self._device.commands]
        self._clocks: Subscription[Clock] | None = None
        if self._sim_time:
            self._clocks = self.create_subscription(Clock, "/clock", self._on_clock, RELIABLE)
            self._sources.append(self._clocks)
            self._deferred = self.create_timer(PERIOD, self._cycle_when_due, clock=STEADY_CLOCK)
            self._deferred.cancel()
        self._partners = AnsweringNodes(self)

    def _why_not_ready(self) -> str:
        missing = self._missing()
        return f"waiting for {', '.join(missing)}" if missing else ""

    def _missing(self) -> list[str]:
        if not self._active:
            return [self._waiting_for]
        if self._clocks is not None and one_too_many(self, self._clocks):
            return [f"one /clock: {one_too_many(self, self._clocks)}"]
        missing = []
        publishers = self._device.publishers
        if self._settings.lock_step:
            missing += unheard(self, [publisher.topic_name for publisher in publishers])
        if self._settings.wait_for_recorder:
            missing += unrecorded(self, publishers)
            missing += self._partners.unaware_sources(self._sources)
        return missing

    # ---- the cycle ----------------------------------------------------------------------------

    def _on_timer(self) -> None:
        self._timer.timer_period_ns = round(self._schedule.begin(time.monotonic()) * NANOSECONDS)
        self._timer.reset()
        # A stop from before the configuration does not end the search for drives.
        if self._supervisor.state is State.UNCONFIGURED or self._autostart:
            self._start_by_itself()
            return
        if self._sim_time:
            # Simulated time may stand still; watchdogs do not.
            self._drives.beat()
            self._link.run(self._drives.hear_first(time.monotonic()))
            self._supervisor.observe(time.monotonic())
            self._device.report()
            return
        self._cycle(self.get_clock().now().nanoseconds, _REPLY_WAIT)

    def _on_clock(self, message: Clock) -> None:
        if self._supervisor.state is State.UNCONFIGURED:
            return
        assert self._clocks is not None
        too_many = one_too_many(self, self._clocks)
        if too_many:
            self._supervisor.fail(too_many)
            self._device.report()
            return
        ros_ns = to_nanoseconds(message.clock)
        if ros_ns < 0:  # rclpy's own ear refuses it by name
            return
        if self._cycle_clock.tell(ros_ns):
            # A clock that stands still is repeated for whoever comes late; so are the joints.
            self._device.publish_joint_states(ros_ns, time.monotonic())
        self._supervisor.note_time(ros_ns, time.monotonic())
        self._cycle_when_due()

    def _cycle_when_due(self) -> None:
        now = time.monotonic()
        self._deferred.cancel()
        ros_ns = self._cycle_clock.take(now)
        if ros_ns is not None:
            self._cycle(ros_ns, self._settings.reply_age_limit)
        elif self._cycle_clock.waits:
            self._deferred.timer_period_ns = int(self._cycle_clock.wait(now) * NANOSECONDS) + 1
            self._deferred.reset()

    def _cycle(self, ros_ns: int, wait: float) -> None:
        now = time.monotonic()
        self._supervisor.note_time(ros_ns, now)
        self._drives.collect()
        self._supervisor.drive(PERIOD, now)
        self._link.run(self._drives.exchange(wait))
        observed = time.monotonic()
        self._supervisor.observe(observed)
        self._device.report()
        # Last: whoever waits for this cycle's joints has heard all that came of it.
        self._device.publish_joint_states(ros_ns, observed)

    def _tell_health(self) -> None:
        values = {
            "late_cycles": str(self._schedule.late),
            # since the last word on it
            "longest_cycle_s": f"{self._schedule.take_longest():.4f}",
        }
        health = self._drives.health(f"waiting for {self._waiting_for}", values)
        self._diagnostics.set("can", health)

    # ---- lifecycle ----------------------------------------------------------------------------

    def _start_by_itself(self) -> None:
        now = time.monotonic()
        if not self._autostart or now < self._retry_at:
            return
        self._retry_at = now + _RETRY
        if self._device.others:
            raise UserError(f"{self.get_fully_qualified_name()}: {self._device.others}")
        why_not = self._link.run(self._drives.probe())
        if not why_not and self._supervisor.state is not State.UNCONFIGURED:
            reply = self._supervisor.reset(now)
            why_not = "" if reply.success else reply.message
        if not why_not:
            self._ends_if_refused = True
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self._ends_if_refused = False
                self.trigger_activate()
                return
            raise UserError(f"{self.get_fully_qualified_name()}: {self._refusal}")
        if now > self._give_up_at:
            raise UserError(f"{self.get_fully_qualified_name()}: {why_not}")
        if not self._waiting_for.endswith(why_not):
            self._waiting_for = f"the drives: {why_not}"
            self.get_logger().info(f"waiting for {self._waiting_for}")

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Open the link and set both drives up; moves nothing."""
        if self._supervisor.state is not State.UNCONFIGURED:
            # A fault from before the configuration; an emergency stop that is pressed stays.
            self._supervisor.reset(time.monotonic())
        why_not = self._link.run(self._drives.probe())
        simulated = not why_not and self._is_simulated()
        if self._settings.lock_step and not (why_not or simulated):
            why_not = "lock_step: a drive does not say that it is emulated; a real motor would turn"
        if not why_not:
            reply = self._supervisor.configure(time.monotonic())
            why_not = "" if reply.success else reply.message
        self._refusal = why_not
        if not why_not:
            self._device.simulated = simulated
            # Once, whoever did it: afterwards the lifecycle is in somebody's hands.
            self._autostart = False
        elif self._ends_if_refused:
            return TransitionCallbackReturn.FAILURE
        self._device.report()
        if why_not:
            self.get_logger().error(f"not configured: {why_not}")
            return TransitionCallbackReturn.FAILURE
        for text in self._drives.missing_optional_objects:
            self._drives.beat()  # many words take longer than a watchdog waits
            self.get_logger().warning(text)
        self._tell_health()
        return TransitionCallbackReturn.SUCCESS

    def _is_simulated(self) -> bool:
        """Return whether this is part of a simulation: its time, and drives without motors."""
        nodes = [self._settings.drive(name).node_id for name in ("insertion", "rotation")]
        try:
            return self._sim_time and self._link.run(are_emulated(self._link, nodes))
        except LinkError:
            return False

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Answer to services from now on."""
        self._active = True
        self.get_logger().info(f"both drives are there on {self._link.settings}")
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Stop and switch off."""
        self._active = False
        self._waiting_for = "the driver to be activated"
        self._supervisor.enable(False, time.monotonic())
        self._device.report()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Switch off and let go of drives and link."""
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Do as `on_cleanup` does, and end."""
        self._let_go()
        self.ended = True
        return TransitionCallbackReturn.SUCCESS

    def _LifecycleNodeMixin__change_state(  # noqa: N802 - rclpy's own name for it
        self, transition: int
    ) -> TransitionCallbackReturn:
        """Refuse a transition that the present state does not have; rclpy would end the node."""
        try:
            return super()._LifecycleNodeMixin__change_state(transition)
        except RCLError as error:
            self.get_logger().warning(f"transition refused: {error}")
            return TransitionCallbackReturn.FAILURE

    def fail(self, why: str) -> None:
        """Stop both axes: a callback ended half-way, and nobody knows what it left."""
        self._supervisor.fail(f"internal error: {why}")
        self._device.report()

    def close(self) -> None:
        """Stop both axes, switch them off, let go of the link."""
        self._active = False
        self._let_go()
        self._device.close()

    def _let_go(self) -> None:
        self._active = False
        self._supervisor.deconfigure()
        self._device.simulated = None
        self._device.report()
        self._link.close()


def main() -> int:
    """Run device_driver; returns its exit code."""
    # What python-can has to say comes as faults of the axes.
    logging.getLogger("can").addHandler(logging.NullHandler())

    def spin(node: Node, end: EndRequest) -> int:
        assert isinstance(node, DeviceDriverNode)
        with (
            contextlib.closing(ParameterDesk(node, PARAMETERS)) as desk,
            executor_of(node, node.fail) as executor,
            contextlib.closing(node),
        ):
            # What is there stays: no collection need look through it while the drives wait.
            gc.freeze()
            # Its start takes the processor: not once the drives wait for a heartbeat.
            while not (end.wanted or desk.ready(_DESK_LOOK)):
                pass
            while not (end.wanted or node.ended):
                executor.spin_once(timeout_sec=0.1)
        return EXIT_DONE

    return run_node(
        DeviceDriverNode,
        help_text=HELP,
        parameters=DeviceDriverParameters,
        spin=spin,
        grace=_GRACE,
        shared_memory=False,
    )


if __name__ == "__main__":
    sys.exit(main())
