"""The names of all safety rules: each refusal, abort and fault carries the one it comes from."""

from __future__ import annotations

import enum


class Rule(enum.Enum):
    """A safety rule; docs/safety.md has the bound, the reason and the test of each."""

    HOLD_TO_RUN = "hold_to_run"
    HOLD_AGE = "hold_age"
    HOLD_NEW_PRESS = "hold_new_press"
    HOLD_ONE_OWNER = "hold_one_owner"
    HOLD_STAMP_INCREASES = "hold_stamp_increases"
    SPEED_SCALE = "speed_scale"
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
    REPLY_AGE = "reply_age"
