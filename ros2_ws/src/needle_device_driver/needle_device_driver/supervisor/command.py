"""A step command, and the rules that refuse it whole."""

from __future__ import annotations

import dataclasses
import math

from needle_common.foreign_text import plain_list
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import HARD_STEP_TIME_CAP, SafetyLimits

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
        Nominal duration [s].
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
        The way; one point is wanted.
    """

    stamp_ns: int
    joint_names: tuple[str, ...]
    points: tuple[CommandPoint, ...]


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
    tip_age : float or None
        Steady age of the command's stamp [s]; None: from the future.
    publishers : int
        How many publish commands.
    """

    insertion: float
    rotation: float
    homed: bool
    not_new: str
    tip_age: float | None
    publishers: int


@dataclasses.dataclass(frozen=True)
class Step:
    """A command that broke no rule: where to go [m], [rad], and in what time at full speed [s]."""

    insertion: float
    rotation: float
    duration: float


@dataclasses.dataclass(frozen=True)
class Refusal:
    """The rule that a command broke, and how, with value and bound."""

    rule: Rule
    reason: str


def check_command(
    command: Command, context: CommandContext, limits: SafetyLimits
) -> Step | Refusal:
    """Return the step that a command asks for, or the first rule that it breaks.

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
    Step or Refusal
        Never a part of a command.
    """
    if context.publishers > 1:
        return Refusal(
            Rule.COMMAND_ONE_PUBLISHER, f"{context.publishers} nodes publish commands, wanted 1"
        )
    wrong = _check_form(command) or _check_time(command, context, limits)
    if wrong is not None:
        return wrong
    if not context.homed:
        return Refusal(Rule.HOMED_FIRST, "the axes are not homed")
    point = command.points[0]
    targets = dict(zip(command.joint_names, point.positions, strict=True))
    step = Step(targets[INSERTION_JOINT], targets[ROTATION_JOINT], point.time_from_start)
    return _check_bounds(step, context, limits) or step


def _check_form(command: Command) -> Refusal | None:
    names = command.joint_names
    if set(names) != {INSERTION_JOINT, ROTATION_JOINT} or len(names) != 2:
        return Refusal(
            Rule.COMMAND_FORM,
            f"joints {plain_list(names)}, wanted {INSERTION_JOINT}, {ROTATION_JOINT}",
        )
    if len(command.points) != 1:
        return Refusal(Rule.COMMAND_FORM, f"{len(command.points)} points, wanted 1")
    point = command.points[0]
    if len(point.positions) != len(names):
        return Refusal(Rule.COMMAND_FORM, f"{len(point.positions)} positions, wanted 2")
    if not all(map(math.isfinite, (*point.positions, *point.others, point.time_from_start))):
        return Refusal(Rule.COMMAND_FINITE, "a number is not finite")
    if not 0.0 < point.time_from_start <= HARD_STEP_TIME_CAP:
        return Refusal(
            Rule.COMMAND_FORM,
            f"time_from_start {point.time_from_start:g} s, wanted > 0 s and at most "
            f"{HARD_STEP_TIME_CAP:g} s",
        )
    return None


def _check_time(command: Command, context: CommandContext, limits: SafetyLimits) -> Refusal | None:
    if context.not_new:
        return Refusal(Rule.COMMAND_NEWER, context.not_new)
    if context.tip_age is None:
        return Refusal(Rule.TIP_AGE, f"stamp {command.stamp_ns} ns is from the future")
    if context.tip_age > limits.tip_age_limit:
        return Refusal(
            Rule.TIP_AGE,
            f"the tip is {context.tip_age:.3f} s old, limit {limits.tip_age_limit:g} s",
        )
    return None


def _check_bounds(step: Step, context: CommandContext, limits: SafetyLimits) -> Refusal | None:
    length = step.insertion - context.insertion
    rotation = abs(step.rotation - context.rotation)
    if length <= 0.0:
        return Refusal(
            Rule.FORWARD_ONLY,
            f"insertion {step.insertion * 1e3:.4g} mm is not ahead of "
            f"{context.insertion * 1e3:.4g} mm",
        )
    speed, rate = length / step.duration, rotation / step.duration
    turns = abs(step.rotation) / (2 * math.pi)
    bounded = (
        (Rule.MAX_DEPTH, "depth", step.insertion * 1e3, limits.max_depth * 1e3, "mm"),
        (Rule.MAX_STEP_LENGTH, "step", length * 1e3, limits.max_step_length * 1e3, "mm"),
        (Rule.MAX_SPEED, "speed", speed * 1e3, limits.max_speed * 1e3, "mm/s"),
        (Rule.MAX_ROTATION_STEP, "rotation", rotation, limits.max_rotation_step, "rad"),
        (Rule.MAX_ROTATION_RATE, "rotation rate", rate, limits.max_rotation_rate, "rad/s"),
        (Rule.MAX_TURNS, "accumulated rotation", turns, limits.max_turns, "turns"),
    )
    for rule, name, value, bound, unit in bounded:
        if value > bound * _ROUNDING:
            return Refusal(rule, f"{name} {value:.6g} {unit} is beyond {bound:.6g} {unit}")
    return None
