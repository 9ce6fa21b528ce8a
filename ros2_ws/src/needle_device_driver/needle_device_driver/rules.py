"""Names of the safety rules; each refusal, abort and fault carries one."""

from __future__ import annotations

import enum
from typing import NamedTuple


class Rule(enum.Enum):
    """A safety rule; docs/safety.md states its bound."""

    HOLD_TO_RUN = "hold_to_run"
    HOLD_AGE = "hold_age"
    HOLD_NEW_PRESS = "hold_new_press"
    HOLD_ONE_OWNER = "hold_one_owner"
    HOLD_IN_ORDER = "hold_in_order"
    SPEED_SCALE = "speed_scale"
    ONE_DEVICE = "one_device"
    NO_MOTION_BY_ITSELF = "no_motion_by_itself"
    COMMAND_STATE = "command_state"
    COMMAND_ONE_PUBLISHER = "command_one_publisher"
    COMMAND_FORM = "command_form"
    COMMAND_FINITE = "command_finite"
    COMMAND_NEWER = "command_newer"
    TIP_AGE = "tip_age"
    HOMED_FIRST = "homed_first"
    FORWARD_ONLY = "forward_only"
    MAX_DEPTH = "max_depth"
    MAX_STEP_LENGTH = "max_step_length"
    MAX_SPEED = "max_speed"
    MAX_ROTATION_STEP = "max_rotation_step"
    MAX_ROTATION_RATE = "max_rotation_rate"
    MAX_TURNS = "max_turns"
    COORDINATED = "coordinated"
    FOLLOWING_ERROR = "following_error"
    RETRACTION = "retraction"
    UNHOMED_OUTWARD_ONLY = "unhomed_outward_only"
    HOMING_NEEDLE_OUT = "homing_needle_out"
    HOMING_TIME = "homing_time"
    ESTOP_LATCHES = "estop_latches"
    ONE_FAULT_STOPS_BOTH = "one_fault_stops_both"
    INNER_LIMIT_SWITCH = "inner_limit_switch"
    REPLY_AGE = "reply_age"
    AXIS_SPEED = "axis_speed"
    SETTLING_TIME = "settling_time"
    LINK_LOSS = "link_loss"
    ONE_MASTER = "one_master"
    DRIVE_WATCHDOG = "drive_watchdog"
    DRIVE_EMERGENCY = "drive_emergency"
    DRIVE_REBOOT = "drive_reboot"
    QUICK_STOP = "quick_stop"
    SOFTWARE_LIMITS = "software_limits"
    LOOK_AHEAD = "look_ahead"
    LOOP_HEARTBEAT = "loop_heartbeat"


class Problem(NamedTuple):
    """The rule that a command, a motion or an axis breaks, and how."""

    rule: Rule
    text: str
