"""Invariants of every run, checked on motors, hand and published messages."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Sequence

from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_device_driver.supervisor.limits import SafetyLimits
from scenario.monitors.bag_monitor import WAITING_LIMIT
from scenario.monitors.hold_monitor import HoldMonitor
from scenario.monitors.limit_monitor import LimitMonitor

# Largest motion in a tick of a motor at rest [m], [rad].
_REST_INSERTION, _REST_ROTATION = 2e-7, 5e-4
# Distance to the set-point at which an axis has arrived [m], [rad] (config/drives.yaml). An axis
# that was blocked there moves the rest when it is freed after a stop.
_ARRIVED_INSERTION, _ARRIVED_ROTATION = 5e-6, 1e-3
# Time from a release or a loss to the last motion [s]: joystick time-out (0.1), operator time-out
# (0.1), their periods and the driver's cycle (0.02 each), stop of the driver (0.02), ramp (0.03),
# and the lateness of each.
RELEASE_BOUND = 0.35
# Duration of a stop by the watchdog of the drives, with the ramp [s].
WATCHDOG_BOUND = 0.2
# Discovery time of a new publisher [s], whose press counts from then (docs/safety.md,
# hold_new_press).
DISCOVERED_WITHIN = 0.2
# Longest time after which a page's hold may still be published once the finger is lifted [s]: an
# echo counts for 0.25 s (docs/safety.md, hold's end), and the hand is sampled every 0.005 s.
PAGE_LIFETIME = 0.26
# Largest lag of a status behind the motors [s].
_STATUS_LAG = 0.15
# The controller learns of a motion with its next tip: two steps [m].
_BELIEF = 0.0045
# Number of commands that may still be executed: a path ends when its tip is 2 s old, also where
# newer commands were refused, and tips come 20 times a second.
_COMMANDS = 50
# Tolerated insertion beyond the command [m], and rotation out of proportion [rad]: a rotation drive
# may fall silent at 3 rad/s, and insertion continues until that is detected.
_BEYOND_COMMAND, _OUT_OF_PROPORTION = 0.0006, 0.5
# Small messages have an eighth more room, and the last one may exceed it [B].
_WAITING = WAITING_LIMIT + WAITING_LIMIT // 8 + 70_000


@dataclasses.dataclass(frozen=True)
class Violation:
    """One violation of an invariant.

    Attributes
    ----------
    invariant : str
        Its name.
    at : float
        Time from the start of the run [s].
    text : str
        Observation, with values and units.
    """

    invariant: str
    at: float
    text: str


class InvariantMonitor:
    """Checks the invariants of one run. Times are seconds from its start.

    Parameters
    ----------
    bounds : SafetyLimits
        Limits of the rig.
    release_bound : float
        Longest time from a release or a loss to the last motion [s].
    late : float
        Lateness of the driver's set-points [s].

    Attributes
    ----------
    violations : list of Violation
        The first of each kind.
    hold_monitor : HoldMonitor
        Monitor of the holds that reach the device; used once it has received any.
    """

    def __init__(
        self, bounds: SafetyLimits, release_bound: float = RELEASE_BOUND, late: float = 0.0
    ) -> None:
        self._release_bound = release_bound
        self.violations: list[Violation] = []
        self.hold_monitor = HoldMonitor()
        self._limits = LimitMonitor(bounds, late)
        self._before: tuple[float, float, float] | None = None
        self._pressed_until = self._reported_until = self._other_until = -1.0
        self._pressed_since = self._other_since = -1.0
        self._holds = False
        self._page_holds = False
        self._page_ended = -1.0
        self._must_press_after = 0.0
        self._status = DeviceStatus()
        self._status_at = 0.0
        self._homing_until = -1.0
        self._silent_since: float | None = None
        self._ends_until = -1.0
        self._estop_since: float | None = None
        self._zero = 0.0
        self._commands: deque[tuple[tuple[float, float], ...]] = deque(maxlen=_COMMANDS)
        self._moving_since: float | None = None
        self._rest = (0.0, 0.0)

    def violate(self, invariant: str, at: float, text: str) -> None:
        """Record a violation, the first of each invariant."""
        if all(one.invariant != invariant for one in self.violations):
            self.violations.append(Violation(invariant, at, text))

    # ---- observations ---------------------------------------------------------------------------

    def observe_hand(self, at: float, *, holds: bool) -> None:
        """Observe whether the hand presses a button that could move the needle."""
        if holds and not self._holds:
            self._pressed_since = at
        if holds:
            self._pressed_until = at
        self._holds = holds

    def observe_hold(self, at: float) -> None:
        """Observe a message by which the hand's own node reports a press."""
        self._reported_until = at

    def observe_page_hold(self, at: float, *, pressed: bool) -> None:
        """Observe whether the console reports a press of the hand at its page."""
        idle = at - self._pressed_until
        if pressed and idle > PAGE_LIFETIME:
            text = f"reported as held {idle:.3f} s after the finger was off"
            self.violate("hold_is_current", at, text)
        begins = pressed and not self._page_holds
        if begins and self._pressed_since < self._page_ended - PAGE_LIFETIME:
            since, ended = self._pressed_since, self._page_ended
            text = f"held again by a press of {since:.3f} s; its hold had ended at {ended:.3f} s"
            self.violate("hold_is_current", at, text)
        if self._page_holds and not pressed:
            self._page_ended = at
        self._page_holds = pressed

    def observe_other_hold(self, at: float) -> None:
        """Observe a press of another source, which is a valid hold."""
        if at - self._other_until > self._release_bound:
            self._other_since = at + DISCOVERED_WITHIN
        self._other_until = at

    def observe_device(self, at: float, status: DeviceStatus) -> None:
        """Observe a published device/status."""
        state, before = status.state, self._status.state
        if state in ("FAULT", "ESTOPPED") and not status.fault:
            self.violate("faults_are_named", at, f"{state} without a reason")
        if state in ("HOLDING", "DISABLED") and before not in ("MOVING", "HOLDING", state):
            # Enabled or reset: an earlier press must not count.
            self._must_press_after = at
        if self._is_homing:
            # The watchdog of the drives bounds the motion after any end of a homing.
            self._homing_until = at + WATCHDOG_BOUND
            if status.homed and self._before is not None:
                # Rotation is homed at its present position.
                self._zero = self._before[2]
        self._status, self._status_at = status, at
        self.hold_monitor.observe_owner(at, status.hold_owner)

    def observe_command(self, points: Sequence[tuple[float, float]]) -> None:
        """Observe a command of any sender: insertion [m] and rotation [rad]."""
        if self._before is not None:
            _, insertion, rotation = self._before
            # A late command starts from the present position, to the next point ahead.
            ahead = [point for point in points if point[0] > insertion] or points[-1:]
            self._commands.append(((insertion, rotation - self._zero), *ahead))

    def observe_driver(self, at: float, *, responsive: bool) -> None:
        """Observe whether the driver runs and is connected to its drives."""
        if not responsive and self._silent_since is None:
            self.hold_monitor.lose_device(at)
        self._silent_since = None if responsive else self._silent_since or at
        if not responsive:
            self.hold_monitor.reset()
            # A restarted driver has not received it, and starts disabled.
            self._estop_since = None

    def observe_estop(self, at: float, *, pressed: bool) -> None:
        """Observe a message of the emergency stop."""
        self._estop_since = (self._estop_since or at) if pressed else None

    def observe_set_point(self, at: float, axis: int, place: float | None) -> None:
        """Observe a set-point; see `LimitMonitor.observe_set_point`."""
        for text in self._limits.observe_set_point(at, axis, place):
            self.violate("none_beyond_limits", at, text)

    def observe_drives_resumed(self, at: float) -> None:
        """Observe that drive time was paused until now."""
        self._ends_until = at + WATCHDOG_BOUND

    def observe_motors(self, at: float, insertion: float, rotation: float) -> None:
        """Observe the true position of the motors."""
        before, self._before = self._before, (at, insertion, rotation)
        for text in self._limits.observe_motors(at, insertion, rotation):
            self.violate("none_beyond_limits", at, text)
        if before is None:
            return
        along, around = insertion - before[1], rotation - before[2]
        moves = abs(along) > _REST_INSERTION or abs(around) > _REST_ROTATION
        if self._moving_since is None:
            moves = moves and (
                abs(insertion - self._rest[0]) > _ARRIVED_INSERTION
                or abs(rotation - self._rest[1]) > _ARRIVED_ROTATION
            )
        if not moves:
            if self._moving_since is not None:
                self._rest = insertion, rotation
            self._moving_since = None
            return
        begins, self._moving_since = self._moving_since is None, self._moving_since or at
        if self._is_homing or at <= self._homing_until:
            return
        self._check_hold(at, begins=begins)
        self._check_status(at)
        if along > _REST_INSERTION:
            self._check_path(at, insertion, rotation)

    def observe_waiting(self, at: float, waiting: int) -> None:
        """Observe the amount of data that waits for the recorder's disk [B]."""
        if waiting > _WAITING:
            self.violate("queues_are_bounded", at, f"{waiting} bytes wait, at most {_WAITING}")

    def observe_belief(self, at: float, status: ControllerStatus, *, joints_known: bool) -> None:
        """Observe a needle/controller_status published while joints reach the controller."""
        # Before its first step the controller has only the earlier position of the needle.
        steers = status.state == "STEERING" and status.step != 0
        if not (steers and joints_known) or self._before is None:
            return
        off = self._before[1] - status.insertion_m
        if not -0.0005 <= off <= _BELIEF:
            measured = f"the needle is {self._before[1] * 1e3:.2f} mm in"
            text = f"the controller reports {status.insertion_m * 1e3:.2f} mm, {measured}"
            self.violate("depth_matches_joints", at, text)

    # ---- checks ---------------------------------------------------------------------------------

    @property
    def _is_homing(self) -> bool:
        return self._status.activity == "homing"

    def _check_hold(self, at: float, *, begins: bool) -> None:
        estop = self._estop_since
        if estop is not None and at - estop > self._release_bound:
            self.violate("estop_stops", at, f"motion {at - estop:.3f} s after an emergency stop")
        # The hold lasts while the hand presses and its node reports the press.
        idle = at - max(min(self._pressed_until, self._reported_until), self._other_until)
        if idle > self._release_bound and at > self._ends_until:
            text = f"motion {idle:.3f} s after the last hold that was pressed and published"
            self.violate("no_motion_without_hold", at, text)
        by_others = self.hold_monitor.idle(at) if self.hold_monitor.has_received else 0.0
        if by_others > RELEASE_BOUND and at > self._ends_until:
            text = f"motion {by_others:.3f} s after the last press of an owner reached the device"
            self.violate("no_motion_by_another", at, text)
        since, ready = max(self._pressed_since, self._other_since), self._must_press_after
        if begins and since < ready:
            text = f"motion by a press of {since:.3f} s; the device became ready at {ready:.3f} s"
            self.violate("no_motion_by_itself", at, text)

    def _check_path(self, at: float, insertion: float, rotation: float) -> None:
        """Check that a motion inwards follows one of the last commands."""
        off = [
            abs(rotation - self._zero - _rotation_at(insertion, command))
            for command in self._commands
            if insertion <= max(place[0] for place in command) + _BEYOND_COMMAND
        ]
        where = f"at {insertion * 1e3:.2f} mm"
        if not off:
            text = f"{where} it goes in beyond all of the last commands"
            self.violate("turns_as_commanded", at, text)
        elif min(off) > _OUT_OF_PROPORTION:
            text = f"{where} it is {min(off):.2f} rad from the nearest command"
            self.violate("turns_as_commanded", at, text)

    def _check_status(self, at: float) -> None:
        state = self._status.state
        if state not in ("HOLDING", "DISABLED") or self._silent_since is not None:
            return
        lag = at - max(self._status_at, self._moving_since or at)
        if lag > _STATUS_LAG:
            text = f"it moves {lag:.3f} s after device/status reported {state}"
            self.violate("status_is_true", at, text)


def _rotation_at(insertion: float, command: Sequence[tuple[float, float]]) -> float:
    """Return the commanded rotation at an insertion [rad], from the start of the command."""
    before = command[0]
    for place in command[1:]:
        if insertion <= place[0]:
            share = (insertion - before[0]) / max(place[0] - before[0], 1e-9)
            return before[1] + min(max(share, 0.0), 1.0) * (place[1] - before[1])
        before = place
    return before[1]
