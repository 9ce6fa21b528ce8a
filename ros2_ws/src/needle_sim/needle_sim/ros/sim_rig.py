"""The `sim_rig` executable: stands in for the rig behind the same topics and services."""

from __future__ import annotations

import math
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from needle_core.commands.cli import EXIT_DONE
from needle_core.diagnostics import Diagnostic, Level
from needle_core.process.end_request import EndRequest
from needle_core.process.watched_time import WatchedTime
from needle_core.ros.base_node import DiagnosticsPublisher, executor_of, run_node
from needle_core.ros.conversions import (
    LATCHED,
    NANOSECONDS,
    RELIABLE,
    to_nanoseconds,
    to_stamp,
    values_of,
)
from needle_core.ros.discovery import AnsweringNodes, unheard, unpublished, unrecorded
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_sim.rig.bench import SimulatedBench
from needle_sim.rig.lock_step import Action, LockStep
from needle_sim.rig.pace import Pace
from needle_sim.ros.conversions import stamp_in, to_truth
from needle_sim.ros.drive_follower import DriveFollower
from needle_sim.ros.simulated_device import SimulatedDevice
from needle_sim.ros.simulated_tips import SimulatedTips
from needle_sim.sim_rig_parameters import SimRigParameters

HELP = """\
sim_rig: stands in for the rig, so that every other node runs as on the real one.

Publishes   /clock, sim/tip_pose (the truth);
            levels tip and camera: joint_states, device/status, device/result;
            level tip: needle/tip, needle/tip_pose;
            levels camera and drive: stereo/{left,right}/{image_raw,camera_info}
Subscribes  needle/controller_status;
            levels tip and camera: device/joint_trajectory, device/hold, device/estop;
            levels camera and drive: needle/tip_pose;
            level drive: sim/drive_positions, which moves the needle, and device/status,
            device/result, joint_states of the device_driver that talks to drive_emulator
Services    levels tip and camera: device/{home,retract,stop,reset},
            device/{enable,confirm_needle_out}
"""

TICK_NS = 20_000_000
TICK = TICK_NS / NANOSECONDS
# ROS takes time 0 for "no time yet".
START_NS = NANOSECONDS
_CLOCK_REPEAT = 0.1
_MATCH_CHECK = 0.02
_IDLE = 0.01
_TURNS_PER_LOOK = 5


class SimRigNode(WholeNode):
    """Owns the clock, the simulated bench and the device interface in front of it.

    Parameters
    ----------
    node_arguments : dict
        Passed on to rclpy's Node (a context of its own, parameter overrides).
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("sim_rig", **node_arguments)
        self._settings = values = NodeParameters(self, SimRigParameters).values
        self._bench = SimulatedBench(
            curvature=values.curvature,
            pitch=values.initial_pitch,
            roll=values.initial_roll,
            torsion_play=values.torsion_play,
            torsion_lag=values.torsion_lag,
            tip_noise=values.tip_noise,
            seed=values.seed,
        )
        self._frame_ns = round(NANOSECONDS / values.camera_rate)
        self._lock_step: LockStep | None = None
        self._watched = WatchedTime()
        self._pace: Pace | None = None
        if values.real_time_factor > 0.0:
            self._pace = Pace(TICK, values.real_time_factor)
        else:
            self._lock_step = LockStep(
                answered=values.level != "tip",
                reexpose_after=values.reexpose_after,
                tick_ns=TICK_NS,
                frame_ns=self._frame_ns,
                path_delay_ns=round(values.path_delay * NANOSECONDS),
            )
        self._time_ns = START_NS
        self._started = False
        # What the tick under way is for; None between ticks.
        self._under_way: Action | None = None
        self._ended = ""
        self._missing = ["all partners"]
        self._match_checked_at = -math.inf
        self._clock_told_at = -math.inf
        self._exposures = 0
        self._next_frame_ns = START_NS
        if not self.get_parameter("use_sim_time").value:
            # Its own time without the detour over /clock.
            self.get_clock()._set_ros_time_is_active(True)
            self._set_time(START_NS)

        self._clock_publisher = self.create_publisher(Clock, "/clock", RELIABLE)
        self._truth = self.create_publisher(PoseStamped, "sim/tip_pose", RELIABLE)
        self._diagnostics = DiagnosticsPublisher(self)
        self._device: SimulatedDevice | DriveFollower
        if values.level == "drive":
            self._device = DriveFollower(
                self,
                self._diagnostics,
                self._bench,
                timeout=values.tick_timeout,
                on_step_end=self._on_step_end,
            )
        else:
            self._device = SimulatedDevice(
                self,
                self._diagnostics,
                self._bench,
                values.limits,
                in_lock_step=self._lock_step is not None,
                path_delay=values.path_delay,
                refuse=self._why_not_ready,
                on_step_end=self._on_step_end,
                now=time.monotonic(),
            )
        self._controller_status = self.create_subscription(
            DiagnosticStatus, "needle/controller_status", self._on_controller_status, LATCHED
        )
        self._sensors: SimulatedTips | SimulatedCameras
        if values.level == "tip":
            self._sensors = SimulatedTips(self, self._bench, values)
        else:
            # The renderer takes longer to load than all else: not where nothing is drawn.
            from needle_sim.ros.simulated_cameras import SimulatedCameras  # noqa: PLC0415

            self._sensors = SimulatedCameras(self, self._bench, values, self._on_answer)
        self._partners = AnsweringNodes(self)
        tips = ("needle/tip",) if values.level == "tip" else ()
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"simulates the rig at level {values.level}, seed {values.seed}",
            lambda: [] if self._started else self._missing,
            alone_on=("/clock", *tips),
        )

    # ---- the loop -----------------------------------------------------------------------------

    def turn(self) -> float:
        """Do what is due now.

        Returns
        -------
        float
            How long the loop may wait for callbacks before the next turn [s].
        """
        now = time.monotonic()
        if not self._started:
            self._start_if_matched(now)
            self._idle(now)
            return _IDLE
        if self._under_way is not None and not self._finish_tick(now):
            return self._device.patience
        if self._pace is not None:
            return self._turn_in_real_time(self._pace, now)
        assert self._lock_step is not None
        self._device.observe(now)
        trips = self._lock_step.watchdog_trips
        action = self._lock_step.next_action(
            time_ns=self._time_ns,
            heard_command_ns=self._device.heard_command(),
            under_way=self._device.under_way(),
            may_move=self._device.may_move(now),
            held=self._device.held(now),
            now=self._watched_now(),
        )
        if self._lock_step.watchdog_trips > trips:
            self._device.count_watchdog_trip()
            self.get_logger().warning(
                f"nothing heard for {self._settings.reexpose_after:g} s: exposed again"
            )
        if self._ended and action is Action.EXPOSE:
            action = Action.WAIT
        if action is Action.WAIT:
            self._idle(now)
            return _IDLE
        self._tick(action, now)
        return 0.0

    def turns(self) -> float:
        """Do a few turns in a row, for a look at the callbacks costs as much as a tick."""
        wait = 0.0
        # Behind real time, more ticks in a row would keep the hold's messages waiting.
        for _ in range(_TURNS_PER_LOOK if self._pace is None else 1):
            wait = self.turn()
            if wait > 0.0 or self._under_way is not None:
                break
        return wait

    def close(self) -> None:
        """Stop what is ours to stop, and say so."""
        self._device.close()
        self._sensors.close()

    def _turn_in_real_time(self, pace: Pace, now: float) -> float:
        if pace.wait(now) > 0.0:
            return pace.wait(now)
        pace.tick(now)
        then_ns = self._time_ns + TICK_NS
        if due := then_ns >= self._next_frame_ns and not self._ended:
            self._next_frame_ns = then_ns + self._frame_ns
        self._tick(Action.EXPOSE if due else Action.TICK, now)
        return pace.wait(time.monotonic())

    def _watched_now(self) -> float:
        return self._watched.read(time.monotonic())

    def _idle(self, now: float) -> None:
        self._device.observe(now)
        repeat = now - self._clock_told_at >= _CLOCK_REPEAT
        if repeat:
            self._tell_time(now)
        # A partner that others had matched before this node did has missed the first joints.
        self._device.idle(
            self._time_ns, now, repeat=repeat and self._started and not self._exposures
        )

    def _tick(self, action: Action, now: float) -> None:
        """Let a tick go by, and expose at its end if that is the action."""
        self._set_time(self._time_ns + TICK_NS)
        self._under_way = action
        self._device.begin_tick(self._time_ns, TICK, now)
        self._tell_time(now)
        self._finish_tick(now)

    def _finish_tick(self, now: float) -> bool:
        """Do what is due at the end of a tick; returns whether it has ended."""
        if not self._device.end_tick(self._time_ns, now):
            return False
        action, self._under_way = self._under_way, None
        self._end_outside_phantom()
        if action is Action.EXPOSE:
            self._expose(now)
        return True

    def _set_time(self, time_ns: int) -> None:
        self._time_ns = time_ns
        self.get_clock().set_ros_time_override(Time(nanoseconds=time_ns))

    def _tell_time(self, now: float) -> None:
        self._clock_publisher.publish(Clock(clock=to_stamp(self._time_ns)))
        self._clock_told_at = now

    def _expose(self, now: float) -> None:
        stamp = to_stamp(self._time_ns)
        number = self._exposures
        self._exposures += 1
        self._truth.publish(to_truth(self._bench.plant.T_rig_tip, stamp))
        self._sensors.expose(number, stamp)
        if self._lock_step is not None:
            self._lock_step.exposed(self._time_ns, self._watched_now())
        self._tell_health()

    def _tell_health(self) -> None:
        lost = 0 if self._pace is None else self._pace.lost_ticks
        values = {
            "exposures": str(self._exposures),
            "lost_ticks": str(lost),
            "simulated_s": f"{(self._time_ns - START_NS) / NANOSECONDS:.2f}",
        }
        level, message = Level.OK, "running"
        if self._ended:
            level, message = Level.ERROR, self._ended
        elif lost:
            factor = self._settings.real_time_factor
            level, message = Level.WARN, f"too slow for real_time_factor {factor:g}"
        self._diagnostics.set("simulation", Diagnostic(level, message, values))

    def _end_outside_phantom(self) -> None:
        tip = self._bench.tip[:2].tolist()
        for axis, place, half_size in zip("xy", tip, self._sensors.half_sizes, strict=True):
            if abs(place) > half_size:
                self._end_run(
                    f"the tip left the phantom: {axis} = {place * 1e3:.2f} mm is beyond "
                    f"{math.copysign(half_size, place) * 1e3:.2f} mm"
                )

    def _end_run(self, why: str) -> None:
        if self._ended:
            return
        self._ended = why
        # The cause is heard before what follows from it.
        self._tell_health()
        self._device.end_run(why)

    # ---- start --------------------------------------------------------------------------------

    def _start_if_matched(self, now: float) -> None:
        if now - self._match_checked_at < _MATCH_CHECK:
            return
        self._match_checked_at = now
        self._missing = self._missing_partners()
        if self._missing:
            self._diagnostics.set(
                "simulation", Diagnostic(Level.WARN, f"waiting for {', '.join(self._missing)}")
            )
            return
        self._started = True
        self._tell_time(now)
        self._device.idle(self._time_ns, now, repeat=True)
        self._tell_health()
        self.get_logger().info("all partners are there: time starts")

    def _missing_partners(self) -> list[str]:
        publishers = [*self._device.publishers, *self._sensors.heard]
        subscriptions = [
            *self._device.subscriptions,
            self._controller_status,
            *self._sensors.subscriptions,
        ]
        missing = unheard(self, [publisher.topic_name for publisher in publishers])
        missing += unpublished(self, subscriptions)
        missing += self._device.missing()
        if not missing and self._settings.wait_for_recorder:
            publishers += [self._truth, *self._sensors.publishers]
            missing += unrecorded(self, publishers)
            missing += self._partners.unaware_sources(subscriptions)
        return missing

    def _why_not_ready(self) -> str:
        if self._ended:
            return f"the run has ended: {self._ended}"
        return "" if self._started else f"waiting for {', '.join(self._missing)}"

    # ---- callbacks ----------------------------------------------------------------------------

    def _on_step_end(self) -> None:
        if self._lock_step is not None:
            self._lock_step.step_ended(self._watched_now())

    def _on_controller_status(self, message: DiagnosticStatus) -> None:
        if self._lock_step is None:
            return
        values = values_of(message)
        self._lock_step.take_controller_status(
            values.get("state", ""),
            values.get("awaiting", ""),
            stamp_in(values, "tip_after_ns"),
            self._watched_now(),
            continuous=values.get("insertion") == "continuous",
            command_ns=stamp_in(values, "command_ns"),
        )

    def _on_answer(self, message: PoseWithCovarianceStamped) -> None:
        if self._lock_step is not None:
            self._lock_step.take_answer(
                to_nanoseconds(message.header.stamp),
                math.isfinite(message.pose.covariance[0]),
                self._watched_now(),
            )
            if self._lock_step.why_stuck:
                self._end_run(self._lock_step.why_stuck)


def main() -> int:
    """Run sim_rig; returns its exit code."""

    def spin(node: Node, end: EndRequest) -> int:
        assert isinstance(node, SimRigNode)
        with executor_of(node) as executor:
            while not end.wanted:
                executor.spin_once(timeout_sec=node.turns())
            node.close()
        return EXIT_DONE

    return run_node(SimRigNode, help_text=HELP, parameters=SimRigParameters, spin=spin)


if __name__ == "__main__":
    sys.exit(main())
