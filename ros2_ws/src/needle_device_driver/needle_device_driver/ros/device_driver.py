"""The `device_driver` executable: the `device/...` interface on real drives."""

from __future__ import annotations

import contextlib
import gc
import logging
import queue
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE
from needle_core.component import Action, Actions, Exit, Moment, PortChange, Send
from needle_core.errors import UserError
from needle_core.process.end_request import EndRequest
from needle_core.process.reach import DISCOVERY, is_open
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, executor_of, run_node
from needle_core.ros.conversions import NANOSECONDS, RELIABLE, to_nanoseconds
from needle_core.ros.discovery import (
    AnsweringNodes,
    one_too_many,
    signature,
    unheard,
    unpublished,
    unrecorded,
)
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameter_desk import ParameterDesk
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeLifecycleNode
from needle_device_driver.cia402.cycle_clock import CycleClock, CycleSchedule
from needle_device_driver.device import COMMANDS
from needle_device_driver.device_driver import NOT_ACTIVE, PERIOD, DeviceDriver
from needle_device_driver.link.can_port import Batch, CanPort
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.ros.device_interface import DeviceInterface
from needle_device_driver.supervisor.reports import Reply

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
PERIOD_NS = round(PERIOD * NANOSECONDS)
_DESK_LOOK = 0.1
# From a signal to the end [s]: a drive that is not off by then is switched off by its own watchdog.
_GRACE = 0.8
_SLACK = 0.1 * PERIOD


class DeviceDriverNode(WholeLifecycleNode):
    """The ROS shell of `DeviceDriver`: its clock, its bus, its lifecycle.

    Parameters
    ----------
    node_arguments : dict
        Passed on to rclpy's Node (a context of its own, parameter overrides).
    """

    def __init__(self, **node_arguments: Any) -> None:
        # A long request would hold the cycle up: `ParameterDesk` answers.
        super().__init__("device_driver", start_parameter_services=False, **node_arguments)
        self._settings = values = NodeParameters(self, DeviceDriverParameters).values
        self._sim_time = bool(self.get_parameter("use_sim_time").value)
        if values.lock_step and not self._sim_time:
            raise UserError(f"{self.get_fully_qualified_name()}: lock_step wants use_sim_time")
        self._component = component = DeviceDriver(
            values,
            signature(self),
            in_simulation=self._sim_time,
            on_clock=self._sim_time,
            more_health=self._cycle_health,
        )
        component.search_after(time.monotonic() + (DISCOVERY if is_open() else 0.0))
        self._active = False
        self._exit: Exit | None = None
        self._cycle_clock = CycleClock(PERIOD_NS, lock_step=values.lock_step)
        self._schedule = CycleSchedule(PERIOD, _SLACK)
        self._diagnostics = DiagnosticsPublisher(self)
        self._device = DeviceInterface(
            self,
            component,
            self._diagnostics,
            refuse=self._why_not_ready,
            carry_out=self._carry_out,
        )
        self._sources = [self._device.subscription(COMMANDS)]
        # rclpy's first line takes a tenth of a second: not once the drives wait for a heartbeat.
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"looking for the drives on {values.link_settings}",
            lambda: self._missing() or unpublished(self, self._sources[1:]),
        )
        self._clocks: Subscription[Clock] | None = None
        if self._sim_time:
            self._clocks = self.create_subscription(Clock, "/clock", self._on_clock, RELIABLE)
            self._sources.append(self._clocks)
            self._deferred = self.create_timer(PERIOD, self._cycle_when_due, clock=STEADY_CLOCK)
            self._deferred.cancel()
        self._partners = AnsweringNodes(self)
        cycle, health = component.timers
        self._was_configured = False
        self._on_cycle = cycle.handler
        self._timer = self.create_timer(PERIOD, self._on_timer, clock=STEADY_CLOCK)
        self.create_timer(health.period, partial(self._do, health.handler), clock=STEADY_CLOCK)
        self._arrived: queue.SimpleQueue[Batch | PortChange] = queue.SimpleQueue()
        self._bell = self.create_guard_condition(self._take_arrived)
        self._port = CanPort(values.link_settings)
        self._port.open(self._arrive)
        self._take_arrived()

    def _cycle_health(self) -> dict[str, str]:
        # The longest since the last word on it.
        longest = f"{self._schedule.take_longest():.4f}"
        return {"late_cycles": str(self._schedule.late), "longest_cycle_s": longest}

    @property
    def ended(self) -> bool:
        """Tell whether the driver has ended by itself."""
        return self._exit is not None

    def _why_not_ready(self) -> str:
        missing = self._missing()
        return f"waiting for {', '.join(missing)}" if missing else ""

    def _missing(self) -> list[str]:
        if not self._active:
            return [(self._component.waiting or NOT_ACTIVE).removeprefix("waiting for ")]
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

    # ---- events -------------------------------------------------------------------------------

    def _do(self, handler: Callable[..., Actions], *arguments: Any) -> None:
        self._device.do(handler(*arguments, self._device.moment()))

    def _carry_out(self, action: Action) -> None:
        match action:
            case Send(_, frames):
                self._port.send(frames)
            case Exit(code, text):
                self._exit = action
                if code == EXIT_BAD_INPUT:
                    raise UserError(f"{self.get_fully_qualified_name()}: {text}")
                if code != EXIT_DONE:
                    raise RuntimeError(text)

    def _arrive(self, item: Batch | PortChange) -> None:
        """Take what comes from the port, in its thread."""
        self._arrived.put(item)
        self._bell.trigger()

    def _take_arrived(self, wait: float = 0.0) -> None:
        """Hand on all that has come, or what comes first within `wait` [s]."""
        (port,) = self._component.ports
        with contextlib.suppress(queue.Empty):
            item = self._arrived.get(timeout=wait) if wait else self._arrived.get_nowait()
            while True:
                handler = port.on_change if isinstance(item, PortChange) else port.handler
                self._do(handler, item)
                item = self._arrived.get_nowait()
        self._follow()

    def _on_timer(self) -> None:
        self._timer.timer_period_ns = round(self._schedule.begin(time.monotonic()) * NANOSECONDS)
        self._timer.reset()
        # What has come came before the time that goes by now.
        self._take_arrived()
        if self._component.searches:
            self._device.look_around()
        self._do(self._on_cycle)
        self._follow()

    def _follow(self) -> None:
        """Do what the component has become ready for: be active, begin a cycle on /clock."""
        if self._settings.autostart and self._component.is_set_up and not self._was_configured:
            self.trigger_configure()
            self.trigger_activate()
        if self._clocks is not None:
            self._cycle_when_due()

    def _on_clock(self, message: Clock) -> None:
        if not self._component.is_set_up:
            return
        assert self._clocks is not None
        too_many = one_too_many(self, self._clocks)
        if too_many:
            self._do(self._component.fail, too_many)
            return
        ros_ns = to_nanoseconds(message.clock)
        if ros_ns < 0:  # rclpy's own ear refuses it by name
            return
        at = Moment(time.monotonic(), ros_ns)
        if self._cycle_clock.tell(ros_ns):
            # A clock that stands still is repeated for whoever comes late; so are the joints.
            self._device.do(self._component.repeat_joint_states(at))
        self._component.supervisor.note_time(ros_ns, at.steady)
        self._cycle_when_due()

    def _cycle_when_due(self) -> None:
        self._deferred.cancel()
        if not self._component.is_set_up or self._component.is_busy:
            return
        now = time.monotonic()
        ros_ns = self._cycle_clock.take(now)
        if ros_ns is not None:
            at = Moment(now, ros_ns)
            self._device.do(self._component.begin_cycle(at, self._settings.reply_age_limit))
        elif self._cycle_clock.waits:
            self._deferred.timer_period_ns = int(self._cycle_clock.wait(now) * NANOSECONDS) + 1
            self._deferred.reset()

    def _wait_while(self, goes_on: Callable[[], bool]) -> None:
        """Let the component go on until something has ended: a transition answers at its end."""
        while goes_on():
            self._take_arrived(PERIOD / 2.0)
            self._do(self._on_cycle)

    # ---- lifecycle ----------------------------------------------------------------------------

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Set both drives up; moves nothing."""
        component = self._component
        # Once, whoever does it: afterwards the lifecycle is in somebody's hands.
        searched, component.searches, self._was_configured = component.searches, False, True
        self._wait_while(lambda: component.is_busy and not component.is_set_up)
        if not component.is_set_up:
            replies: list[str] = []

            def then(reply: Reply, at: Moment) -> Actions:
                replies.append("" if reply.success else reply.message)
                return ()

            self._do(component.set_up, then)
            self._wait_while(lambda: not replies)
            if replies[0]:
                component.searches, self._was_configured = searched, False
                self.get_logger().error(f"not configured: {replies[0]}")
                return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Answer to services from now on."""
        self._active = True
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Stop and switch off."""
        self._active = False
        self._do(self._component.disable)
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Switch off and let go of the drives."""
        self._active = False
        self._do(self._component.take_down)
        self._wait_while(lambda: self._component.is_busy)
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Do as `on_cleanup` does, and end."""
        self._end()
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
        self._do(self._component.fail, f"internal error: {why}")

    def close(self) -> None:
        """Stop both axes, switch them off, let go of the bus."""
        self._end()
        self._port.close()
        self._device.close()

    def _end(self) -> None:
        self._active = False
        # Where the cycle is broken, nobody tells the drives that it is not.
        if self._exit is None:
            self._do(self._component.on_stop)
            self._wait_while(lambda: self._exit is None)


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
