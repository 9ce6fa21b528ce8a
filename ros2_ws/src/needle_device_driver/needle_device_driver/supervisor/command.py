"""A command, step or path, and the rules that refuse it whole.

A step is one point: where both joints go. A path is several, rotation over insertion for the next
piece of a continuous insertion; it may begin where the device has been, with a point at
`time_from_start` 0, and takes the place of the path under way.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

from needle_core.diagnostics import sanitize_list
from needle_device_driver.axes.motion import Leg
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import HARD_STEP_TIME_CAP, SafetyLimits

MOST_POINTS = 32
INSERTION_JOINT = "insertion_joint"
ROTATION_JOINT = "rotation_joint"

# Room for the rounding of a controller that goes exactly to a limit.
_ROUNDING = 1.0 + 1e-9


@dataclasses.dataclass(frozen=True)
class CommandPoint:
    """One point of a command.

    Attributes
    ----------
    positions : tuple of float
        Target of each named joint [m or rad].
    others : tuple of float
        Every other number that the point carries; unused, yet must be finite.
    time_from_start : float
        Nominal time at which it is reached [s].
    """

    positions: tuple[float, ...]
    others: tuple[float, ...]
    time_from_start: float


@dataclasses.dataclass(frozen=True)
class Command:
    """A command as it was received, nothing checked.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the tip that caused it [ns], ROS time.
    joint_names : tuple of str
        Names of the joints, in the order of the positions.
    points : tuple of CommandPoint
        The way; a step has one, a path several.
    """

    stamp_ns: int
    joint_names: tuple[str, ...]
    points: tuple[CommandPoint, ...]

    @property
    def is_path(self) -> bool:
        """Tell whether it may take the place of a path under way."""
        return len(self.points) > 1


@dataclasses.dataclass(frozen=True)
class CommandContext:
    """Circumstances of a command that the rules need to know.

    Attributes
    ----------
    insertion, rotation : float
        Where the joints were last told to be, and a motion begins [m], [rad].
    homed : bool
        Whether both axes are homed.
    not_new : str
        Why the command's stamp is no new one; empty: it is.
    tip_age : float
        Steady age of the command's stamp [s]; negative: from the future.
    publishers : int
        How many publish commands.
    """

    insertion: float
    rotation: float
    homed: bool
    not_new: str
    tip_age: float
    publishers: int


@dataclasses.dataclass(frozen=True)
class Refusal:
    """The rule that a command broke, and how, with value and bound."""

    rule: Rule
    reason: str


def check_command(
    command: Command, context: CommandContext, limits: SafetyLimits
) -> tuple[Leg, ...] | Refusal:
    """Return the way that a command asks for, or the first rule that it breaks.

    Parameters
    ----------
    command : Command
        The command as received.
    context : CommandContext
        Where the device is.
    limits : SafetyLimits
        The bounds.

    Returns
    -------
    tuple of Leg, or Refusal
        Of a path what lies ahead of where the joints were last told to be, nothing where they are
        at its end; otherwise never a part of a command.
    """
    if context.publishers > 1:
        return Refusal(
            Rule.COMMAND_ONE_PUBLISHER, f"{context.publishers} nodes publish commands, wanted 1"
        )
    wrong = check_form(command) or _check_time(command, context, limits)
    if wrong is not None:
        return wrong
    if not context.homed:
        return Refusal(Rule.HOMED_FIRST, "the axes are not homed")
    way = _way(command, context)
    begin = way[0].start[0]
    if begin > context.insertion + limits.insertion_tolerance * _ROUNDING:
        return Refusal(
            Rule.COMMAND_FORM,
            f"the path begins at {begin * 1e3:.6g} mm, ahead of the needle at "
            f"{context.insertion * 1e3:.6g} mm",
        )
    left = way[-1].leg.insertion - context.insertion
    if command.is_path and abs(left) <= limits.insertion_tolerance:
        return ()
    return _check_bounds(way, context, limits) or _ahead(way, context.insertion)


def check_form(command: Command) -> Refusal | None:
    """Return what is wrong with a command wherever the device is; None if nothing is."""
    names, points = command.joint_names, command.points
    if set(names) != {INSERTION_JOINT, ROTATION_JOINT} or len(names) != 2:
        return Refusal(
            Rule.COMMAND_FORM,
            f"joints {sanitize_list(names)}, wanted {INSERTION_JOINT}, {ROTATION_JOINT}",
        )
    if not 0 < len(points) <= MOST_POINTS:
        return Refusal(Rule.COMMAND_FORM, f"{len(points)} points, wanted 1 to {MOST_POINTS}")
    for point in points:
        if len(point.positions) != len(names):
            return Refusal(Rule.COMMAND_FORM, f"{len(point.positions)} positions, wanted 2")
        if not all(map(math.isfinite, (*point.positions, *point.others, point.time_from_start))):
            return Refusal(Rule.COMMAND_FINITE, "a number is not finite")
    return _check_times(command)


def _check_times(command: Command) -> Refusal | None:
    times = [point.time_from_start for point in command.points]
    # A path may begin where the device is, or has been.
    earliest = 0.0 if command.is_path else math.nextafter(0.0, 1.0)
    if not earliest <= times[0] or not times[-1] <= HARD_STEP_TIME_CAP:
        wrong = times[0] if times[0] < earliest else times[-1]
        return Refusal(
            Rule.COMMAND_FORM,
            f"time_from_start {wrong:g} s, wanted > 0 s and at most {HARD_STEP_TIME_CAP:g} s",
        )
    if any(after <= before for before, after in itertools.pairwise(times)):
        return Refusal(Rule.COMMAND_FORM, "time_from_start does not rise from point to point")
    return None


def _check_time(command: Command, context: CommandContext, limits: SafetyLimits) -> Refusal | None:
    if context.not_new:
        return Refusal(Rule.COMMAND_NEWER, context.not_new)
    if context.tip_age < 0.0:
        return Refusal(
            Rule.TIP_AGE, f"the tip is from the future: {clocks_differ(context.tip_age)}"
        )
    if context.tip_age > limits.tip_age_limit:
        return Refusal(
            Rule.TIP_AGE,
            f"the tip is {context.tip_age:.3f} s old, limit {limits.tip_age_limit:g} s",
        )
    return None


def clocks_differ(tip_age: float) -> str:
    """Say what a tip from the future means."""
    return f"its stamp is {-tip_age:.3f} s ahead of this computer's clock"


@dataclasses.dataclass(frozen=True)
class _Piece:
    start: tuple[float, float]
    leg: Leg

    @property
    def length(self) -> float:
        return self.leg.insertion - self.start[0]

    @property
    def turn(self) -> float:
        return abs(self.leg.rotation - self.start[1])


def _way(command: Command, context: CommandContext) -> list[_Piece]:
    """Return the whole way, from its own first point if that is at time 0, else from the joints."""
    insertion, rotation = map(command.joint_names.index, (INSERTION_JOINT, ROTATION_JOINT))
    start, before = (context.insertion, context.rotation), 0.0
    way = []
    for point in command.points:
        at = point.positions[insertion], point.positions[rotation]
        if point.time_from_start > 0.0:
            way.append(_Piece(start, Leg(*at, point.time_from_start - before)))
        start, before = at, point.time_from_start
    return way


def _ahead(way: list[_Piece], insertion: float) -> tuple[Leg, ...]:
    """Return the legs ahead of an insertion [m]; one partly done takes its share of time."""
    ahead = [piece for piece in way if piece.leg.insertion > insertion]
    first = ahead[0]
    part = (first.leg.insertion - insertion) / first.length
    rest = dataclasses.replace(first.leg, duration=first.leg.duration * part)
    return (rest, *(piece.leg for piece in ahead[1:]))


def _check_bounds(
    way: list[_Piece], context: CommandContext, limits: SafetyLimits
) -> Refusal | None:
    end = way[-1].leg.insertion
    length = end - context.insertion
    if length <= 0.0:
        return Refusal(
            Rule.FORWARD_ONLY,
            f"insertion {end * 1e3:.4g} mm is not ahead of {context.insertion * 1e3:.4g} mm",
        )
    back = next((piece for piece in way if piece.length <= 0.0), None)
    if back is not None:
        return Refusal(
            Rule.FORWARD_ONLY,
            f"insertion {back.leg.insertion * 1e3:.4g} mm is not ahead of the point before, "
            f"{back.start[0] * 1e3:.4g} mm",
        )
    # Who commands counts from where the axes are, which may be beside where they were told to be by
    # their tolerance, and a message's times are whole nanoseconds. The motion itself is held to the
    # bounds of speed and rate.
    beside, askew = limits.insertion_tolerance, limits.rotation_tolerance
    speed = max((piece.length - beside) / piece.leg.duration for piece in way)
    rotation = max(abs(piece.leg.rotation - context.rotation) for piece in way)
    rate = max((piece.turn - askew) / piece.leg.duration for piece in way)
    turns = max(abs(piece.leg.rotation) for piece in way) / (2 * math.pi)
    bounded = (
        (Rule.MAX_DEPTH, "depth", end * 1e3, limits.max_depth * 1e3, 0.0, "mm"),
        (
            Rule.MAX_STEP_LENGTH,
            "step",
            length * 1e3,
            limits.max_step_length * 1e3,
            beside * 1e3,
            "mm",
        ),
        (Rule.MAX_SPEED, "speed", speed * 1e3, limits.max_speed * 1e3, 0.0, "mm/s"),
        (Rule.MAX_ROTATION_STEP, "rotation", rotation, limits.max_rotation_step, askew, "rad"),
        (Rule.MAX_ROTATION_RATE, "rotation rate", rate, limits.max_rotation_rate, 0.0, "rad/s"),
        (Rule.MAX_TURNS, "accumulated rotation", turns, limits.max_turns, 0.0, "turns"),
    )
    for rule, name, value, bound, room, unit in bounded:
        if value > (bound + room) * _ROUNDING:
            return Refusal(rule, f"{name} {value:.6g} {unit} is beyond {bound:.6g} {unit}")
    return None
