"""The device at level drive: the real driver and the emulated drives, in step with sim_rig."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Header

from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.process.claim import WAY_OUT
from needle_core.ros.base_node import DiagnosticsPublisher
from needle_core.ros.conversions import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
    values_of,
)
from needle_core.ros.discovery import unheard
from needle_sim.rig.bench import SimulatedBench
from needle_sim.rig.driven_tick import DrivenTick

# Beyond any drive: the shape of a needle there cannot be reckoned [m], [rad].
_FARTHEST = {"insertion_joint": 1.0, "rotation_joint": 1e5}
_PATIENCE = 0.01


class DriveFollower:
    """Moves the bench by what the emulated drives did, never by the driver's word.

    A tick of simulated time is over when the drives have told what they did in it and the driver
    that it has done its cycle: `joint_states` is the last that it says in one.

    Parameters
    ----------
    node : Node
        Gets the subscriptions.
    diagnostics : DiagnosticsPublisher
        Where trips of watchdogs go.
    bench : SimulatedBench
        What is moved.
    timeout : float
        How long a tick may stay unanswered [s], steady clock.
    on_step_end : callable
        Called after each result.

    Attributes
    ----------
    publishers : list of Publisher
        Topics that partners must listen to: none.
    subscriptions : list of Subscription
        Topics that partners must publish.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: DiagnosticsPublisher,
        bench: SimulatedBench,
        *,
        timeout: float,
        on_step_end: Callable[[], None],
    ) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._bench = bench
        self._tick = DrivenTick(timeout)
        self._on_step_end = on_step_end
        self._status: dict[str, str] = {}
        self._motors_turn = False
        self._paused = False
        self._trips = 0
        self._estop = node.create_publisher(Bool, "device/estop", RELIABLE)
        subscribe = node.create_subscription
        # The order matters: what is heard in one look is taken in it.
        self.publishers: list[Publisher[Any]] = []
        self.subscriptions: list[Subscription[Any]] = [
            subscribe(Header, "device/result", self._on_result, RELIABLE),
            subscribe(DiagnosticStatus, "device/status", self._on_status, LATCHED),
            subscribe(JointState, "joint_states", self._on_joint_states, JOINT_STATES),
            subscribe(JointState, "sim/drive_positions", self._on_positions, JOINT_STATES),
        ]

    def missing(self) -> list[str]:
        """Return what else is not there yet."""
        state = self._status.get("state", "")
        missing = [] if state not in ("", "UNCONFIGURED") else ["a configured device_driver"]
        # The controller's ears, which the driver cannot hear without a word of ours.
        return missing + unheard(self._node, ("joint_states", "device/result", "device/status"))

    def observe(self, _: float) -> None:
        """Do nothing: the driver watches."""

    def under_way(self) -> bool:
        """Return whether a motion is under way, of the driver's or of the motors'."""
        return self.may_move(0.0) or self._status.get("activity", "none") != "none"

    def may_move(self, _: float) -> bool:
        """Return whether something would go on if time did."""
        return self._status.get("needs_time") == "true" or self._motors_turn

    def held(self, _: float) -> bool:
        """Return whether somebody's hold counts."""
        return self._status.get("hold_owner", "") != ""

    def heard_command(self) -> int:
        """Return the stamp of the newest command that the device has heard [ns]."""
        return int(self._status.get("command_ns") or 0)

    def begin_tick(self, time_ns: int, _: float, now: float) -> None:
        """Wait from now on for what the tick that ends at `time_ns` [ns] comes to."""
        self._tick.begin(time_ns, now)

    def end_tick(self, _: int, now: float) -> bool:
        """Return whether the tick is over."""
        unanswered = self._tick.unanswered
        self._tick.look()
        over = self._tick.is_over(now)
        if self._tick.unanswered > unanswered:
            # Motors that nobody has heard of any more keep no time going.
            self._motors_turn = False
            silence = f"{self._tick.silent} left a tick unanswered for {self._tick.timeout:g} s"
            self._node.get_logger().warning(silence)
            self._tell_trips(silence)
        return over

    @property
    def patience(self) -> float:
        """Longest wait for callbacks while a tick is under way [s]."""
        return 0.0 if self._tick.answered else _PATIENCE

    def idle(self, _time_ns: int, _now: float, *, repeat: bool) -> None:
        """Do nothing: driver and drives look after themselves."""

    def count_watchdog_trip(self) -> None:
        """Count a watchdog of sim_rig's."""
        self._tell_trips("nothing was heard: exposed again")

    def end_run(self, _reason: str) -> None:
        """Stop both axes for good."""
        self._estop.publish(Bool(data=True))

    def close(self) -> None:
        """Do nothing: the driver ends by itself."""

    def _tell_trips(self, why: str) -> None:
        """Tell a watchdog's trip; each is a change of what diagnostics say."""
        self._trips += 1
        self._diagnostics.set(
            "watchdogs",
            Diagnostic(Level.WARN, f"{why} ({self._trips})", {"watchdog_trips": str(self._trips)}),
        )

    def _on_result(self, _: Header) -> None:
        self._tick.heard()
        self._on_step_end()

    def _on_status(self, message: DiagnosticStatus) -> None:
        self._tick.heard()
        self._status = values_of(message)
        if self._status.get("simulated") == "false":
            raise UserError(
                f"{self._node.get_fully_qualified_name()}: the device is real, or not in simulated "
                f"time ({message.name} says simulated = false): no part of a simulation; {WAY_OUT}"
            )
        paused = is_paused(self._status)
        if paused and not self._paused:
            # Unlike simulated axes, drives take a tick or more to come to rest and to go on.
            self._tell_trips("a hold fell silent: the drives paused")
        self._paused = paused

    def _on_joint_states(self, message: JointState) -> None:
        self._tick.heard()
        self._tick.driver_at(to_nanoseconds(message.header.stamp))

    def _on_positions(self, message: JointState) -> None:
        at = places_of(message)
        self._tick.heard()
        self._tick.drives_moved()
        self._motors_turn = any(velocity != 0.0 for velocity in message.velocity)
        self._bench.move_to(at["insertion_joint"], at["rotation_joint"])


def is_paused(status: Mapping[str, str]) -> bool:
    """Return whether a motion waits for a hold that nobody let go of."""
    return (
        status.get("activity", "none") != "none"
        and status.get("needs_time") != "true"
        and status.get("speed_scale", "0") != "0"
    )


def places_of(message: JointState) -> dict[str, float]:
    """Return where the axes are, by joint [m], [rad].

    Raises
    ------
    ValueError
        A joint is missing, or where no drive can be.
    """
    at = dict(zip(message.name, message.position, strict=True))
    for joint, farthest in _FARTHEST.items():
        place = at.get(joint, math.nan)
        if not abs(place) <= farthest:
            raise ValueError(f"{joint} is at {place:g}: no drive is")
    return at
