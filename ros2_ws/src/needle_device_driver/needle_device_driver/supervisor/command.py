"""Checks of commands, which are refused as a whole if they break a rule; start, replacement.

A step has one point: the target of both joints. A path has several: the rotation as a function of
depth for the next part of a continuous insertion. A path may begin at an earlier position, with a
point at `time_from_start` 0, and replaces the path under way.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

from needle_core.diagnostics import sanitize_list
from needle_core.messages import INSERTION_JOINT, ROTATION_JOINT, Trajectory
from needle_device_driver.axes.axis import PairSnapshot
from needle_device_driver.axes.motion import Leg
from needle_device_driver.rules import Problem, Rule
from needle_device_driver.supervisor.command_stamps import CommandStamps
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.limits import HARD_STEP_TIME_CAP, SafetyLimits
from needle_device_driver.supervisor.motion_run import INNER_SWITCH
from needle_device_driver.supervisor.reports import SUCCEEDED
from needle_device_driver.supervisor.states import Activity, State

MAX_POINTS = 32
# Tolerance for the rounding errors of a controller that moves exactly to a limit.
_ROUNDING = 1.0 + 1e-9


@dataclasses.dataclass(frozen=True)
class CommandContext:
    """State of the device at the arrival of a command.

    Attributes
    ----------
    insertion, rotation : float
        Last set-points of the joints, where a motion begins [m], [rad].
    homed : bool
        Whether both axes are homed.
    not_new : str
        Reason why the command's stamp is not new; else empty.
    tip_age : float
        Steady age of the command's stamp [s]; negative: it is in the future.
    publishers : int
        Number of publishers of commands.
    """

    insertion: float
    rotation: float
    homed: bool
    not_new: str
    tip_age: float
    publishers: int


def is_path(command: Trajectory) -> bool:
    """Return whether a command may replace a path under way."""
    return len(command.points) > 1


def check_command(
    command: Trajectory, context: CommandContext, limits: SafetyLimits
) -> tuple[Leg, ...] | Problem:
    """Return the legs of a command, or the first rule that it breaks.

    Parameters
    ----------
    command : Trajectory
        The command as received.
    context : CommandContext
        State of the device.
    limits : SafetyLimits
        The bounds.

    Returns
    -------
    tuple of Leg, or Problem
        For a path, only the legs ahead of the last set-points; empty if these are at its end.
    """
    if context.publishers > 1:
        return Problem(
            Rule.COMMAND_ONE_PUBLISHER, f"{context.publishers} nodes publish commands, expected 1"
        )
    refusal = check_form(command) or _check_age(context, limits)
    if refusal is not None:
        return refusal
    if not context.homed:
        return Problem(Rule.HOMED_FIRST, "the axes are not homed")
    path = _path(command, context)
    begin = path[0].start[0]
    if begin > context.insertion + limits.insertion_tolerance * _ROUNDING:
        return Problem(
            Rule.COMMAND_FORM,
            f"the path begins at {begin * 1e3:.6g} mm, ahead of the needle at "
            f"{context.insertion * 1e3:.6g} mm",
        )
    left = path[-1].leg.insertion - context.insertion
    if is_path(command) and abs(left) <= limits.insertion_tolerance:
        return ()
    return _check_bounds(path, context, limits) or _legs_ahead(path, context.insertion)


def check_form(command: Trajectory) -> Problem | None:
    """Return the rule that a command breaks in every state of the device."""
    names, points = command.joint_names, command.points
    if sorted(names) != [INSERTION_JOINT, ROTATION_JOINT]:
        return Problem(
            Rule.COMMAND_FORM,
            f"joints {sanitize_list(names)}, expected {INSERTION_JOINT}, {ROTATION_JOINT}",
        )
    if not 0 < len(points) <= MAX_POINTS:
        return Problem(Rule.COMMAND_FORM, f"{len(points)} points, expected 1 to {MAX_POINTS}")
    for point in points:
        if len(point.positions) != len(names):
            return Problem(Rule.COMMAND_FORM, f"{len(point.positions)} positions, expected 2")
        if not all(map(math.isfinite, (*point.positions, *point.others, point.time_from_start))):
            return Problem(Rule.COMMAND_FINITE, "a number is not finite")
    return _check_times(command)


def _check_times(command: Trajectory) -> Problem | None:
    times = [point.time_from_start for point in command.points]
    begins = times[0] >= 0.0 if is_path(command) else times[0] > 0.0
    if not begins or times[-1] > HARD_STEP_TIME_CAP:
        wrong = times[-1] if begins else times[0]
        return Problem(
            Rule.COMMAND_FORM,
            f"time_from_start {wrong:g} s, expected > 0 s and at most {HARD_STEP_TIME_CAP:g} s",
        )
    if any(after <= before for before, after in itertools.pairwise(times)):
        return Problem(Rule.COMMAND_FORM, "time_from_start does not increase from point to point")
    return None


def _check_age(context: CommandContext, limits: SafetyLimits) -> Problem | None:
    if context.not_new:
        return Problem(Rule.COMMAND_NEWER, context.not_new)
    if context.tip_age < 0.0:
        return Problem(
            Rule.TIP_AGE, f"the tip is from the future: {describe_lead(context.tip_age)}"
        )
    if context.tip_age > limits.tip_age_limit:
        return Problem(
            Rule.TIP_AGE,
            f"the tip is {context.tip_age:.3f} s old, limit {limits.tip_age_limit:g} s",
        )
    return None


def describe_lead(tip_age: float) -> str:
    """Return the text for a stamp in the future, that is, of negative age [s]."""
    return f"its stamp is {-tip_age:.3f} s ahead of this computer's clock"


@dataclasses.dataclass(frozen=True)
class _Piece:
    """A leg with its start."""

    start: tuple[float, float]
    leg: Leg

    @property
    def length(self) -> float:
        return self.leg.insertion - self.start[0]

    @property
    def turn(self) -> float:
        return abs(self.leg.rotation - self.start[1])


def _path(command: Trajectory, context: CommandContext) -> list[_Piece]:
    """Return the path from the command's point at time 0, or else from the last set-points."""
    insertion, rotation = map(command.joint_names.index, (INSERTION_JOINT, ROTATION_JOINT))
    start, before = (context.insertion, context.rotation), 0.0
    path = []
    for point in command.points:
        at = point.positions[insertion], point.positions[rotation]
        if point.time_from_start:
            path.append(_Piece(start, Leg(*at, point.time_from_start - before)))
        start, before = at, point.time_from_start
    return path


def _legs_ahead(path: list[_Piece], insertion: float) -> tuple[Leg, ...]:
    """Return the legs ahead of an insertion [m]; the duration of a partial leg is scaled."""
    ahead = [piece for piece in path if piece.leg.insertion > insertion]
    first = ahead[0]
    part = (first.leg.insertion - insertion) / first.length
    rest = dataclasses.replace(first.leg, duration=first.leg.duration * part)
    return (rest, *(piece.leg for piece in ahead[1:]))


def _check_bounds(
    path: list[_Piece], context: CommandContext, limits: SafetyLimits
) -> Problem | None:
    end = path[-1].leg.insertion
    length = end - context.insertion
    if length <= 0.0:
        return Problem(
            Rule.FORWARD_ONLY,
            f"insertion {end * 1e3:.4g} mm is not ahead of {context.insertion * 1e3:.4g} mm",
        )
    back = next((piece for piece in path if piece.length <= 0.0), None)
    if back is not None:
        return Problem(
            Rule.FORWARD_ONLY,
            f"insertion {back.leg.insertion * 1e3:.4g} mm is not ahead of the point before, "
            f"{back.start[0] * 1e3:.4g} mm",
        )
    # A controller starts from the measured joints, which may differ from the last set-points by the
    # tolerances. Speed and rate are also bounded during the motion, without tolerances.
    slack, turn_slack = limits.insertion_tolerance, limits.rotation_tolerance
    speed = max((piece.length - slack) / piece.leg.duration for piece in path)
    rotation = max(abs(piece.leg.rotation - context.rotation) for piece in path)
    rate = max((piece.turn - turn_slack) / piece.leg.duration for piece in path)
    turns = max(abs(piece.leg.rotation) for piece in path) / (2 * math.pi)
    mm = 1e3
    for rule, name, value, bound, tolerance, unit in (
        (Rule.MAX_DEPTH, "depth", end * mm, limits.max_depth * mm, 0.0, "mm"),
        (Rule.MAX_STEP_LENGTH, "step", length * mm, limits.max_step_length * mm, slack * mm, "mm"),
        (Rule.MAX_SPEED, "speed", speed * mm, limits.max_speed * mm, 0.0, "mm/s"),
        (Rule.MAX_ROTATION_STEP, "rotation", rotation, limits.max_rotation_step, turn_slack, "rad"),
        (Rule.MAX_ROTATION_RATE, "rotation rate", rate, limits.max_rotation_rate, 0.0, "rad/s"),
        (Rule.MAX_TURNS, "accumulated rotation", turns, limits.max_turns, 0.0, "turns"),
    ):
        if value > (bound + tolerance) * _ROUNDING:
            return Problem(rule, f"{name} {value:.6g} {unit} is beyond {bound:.6g} {unit}")
    return None


class CommandHandler:
    """Handles commands for a device; `now` is the steady time [s] in every method.

    Parameters
    ----------
    core : DeviceCore
        Executes accepted commands.
    hold : Hold
        Hold-to-run state.
    limits : SafetyLimits
        The bounds of the rules.

    Attributes
    ----------
    stamps : CommandStamps
        Ages of stamps, and stamps of accepted commands.
    refused : int
        Number of refused commands.
    newest_ns : int
        Stamp of the newest command, accepted or refused [ns]; 0: none yet.
    """

    def __init__(self, core: DeviceCore, hold: Hold, limits: SafetyLimits) -> None:
        self._core = core
        self._hold = hold
        self._limits = limits
        self._on_path = False
        self.stamps = CommandStamps()
        self.refused = 0
        self.newest_ns = 0

    def submit(self, command: Trajectory, now: float, publishers: int) -> bool:
        """Handle an unchecked command; return whether it starts a motion."""
        self.newest_ns = command.stamp_ns
        legs = self._check(command, now, publishers)
        if isinstance(legs, Problem):
            self._refuse(command, legs)
            return False
        self.stamps.accept(command.stamp_ns)
        if not legs:
            # An earlier path has reached the end already, or is within tolerance of it.
            self._core.report_result(command.stamp_ns, SUCCEEDED)
            return False
        self._on_path = is_path(command)
        if self._core.activity is Activity.STEP:
            self._core.replace(legs, command.stamp_ns)
        else:
            self._core.start(Activity.STEP, legs, command.stamp_ns)
        return True

    def check_path_age(self, now: float) -> None:
        """Abort a path whose tip is too old: the needle position is no longer known."""
        stamp_ns = self._core.step_stamp_ns
        if not self._on_path or stamp_ns is None:
            return
        age, limit = self.stamps.age(stamp_ns, now), self._limits.tip_age_limit
        # The age is negative if ROS time was set back; the tip would then never expire.
        if not 0.0 <= age <= limit:
            self._core.watchdog_trips += 1
            old = f"{age:.3f} s old, limit {limit:g} s"
            text = f"the tip behind the path is {describe_lead(age) if age < 0.0 else old}"
            self._core.notice(text, Rule.TIP_AGE)
            self._core.abort(text)

    def _check(self, command: Trajectory, now: float, publishers: int) -> tuple[Leg, ...] | Problem:
        at = self._check_device(command, now)
        if isinstance(at, Problem):
            return at
        context = CommandContext(
            insertion=at.insertion.set_point,
            rotation=at.rotation.set_point,
            homed=at.homed,
            not_new=self.stamps.refusal_reason(command.stamp_ns),
            tip_age=self.stamps.age(command.stamp_ns, now),
            publishers=publishers,
        )
        return check_command(command, context, self._limits)

    def _check_device(self, command: Trajectory, now: float) -> PairSnapshot | Problem:
        replaces = is_path(command) and self._on_path and self._core.activity is Activity.STEP
        if self._core.state is not State.HOLDING and not replaces:
            state = self._core.state.value
            return Problem(Rule.COMMAND_STATE, f"the device is {state}, not {State.HOLDING.value}")
        if self._hold.owner is None:
            return Problem(Rule.HOLD_TO_RUN, "the hold is not pressed")
        # Read the axes again: one may have stopped since the last cycle.
        at = self._core.poll(now)
        if at.age(now) > self._limits.reply_age_limit:
            return Problem(Rule.REPLY_AGE, "no fresh reply from the axes")
        if not at.powered:
            return Problem(Rule.COMMAND_STATE, "the axes are not powered yet")
        if at.insertion.at_inner_switch:
            return Problem(Rule.INNER_LIMIT_SWITCH, f"{INNER_SWITCH}: retract")
        return at

    def _refuse(self, command: Trajectory, refusal: Problem) -> None:
        self.refused += 1
        if refusal.rule is Rule.TIP_AGE:
            self._core.watchdog_trips += 1
        self._core.explain(f"command refused: {refusal.text}", refusal.rule)
        # A result with the stamp of the running step would mean that the step has ended.
        if command.stamp_ns != self._core.step_stamp_ns:
            self._core.report_result(command.stamp_ns, f"aborted: {refusal.text}")
