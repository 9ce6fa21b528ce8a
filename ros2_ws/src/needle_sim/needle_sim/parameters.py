"""The parameters of sim_rig."""

from __future__ import annotations

import dataclasses
import math

from needle_common.errors import UserError
from needle_common.parameter_fields import check_fields, parameter
from needle_device_driver.limits import HARD_SPEED_CAP, HARD_STEP_LENGTH_CAP, SafetyLimits
from needle_sim.scenarios import CLEAN, SCENARIOS

LEVELS = ("tip", "camera", "drive")


@dataclasses.dataclass(frozen=True)
class SimRigParameters:
    """Parameters of sim_rig, fixed at start; `check` in `__post_init__` refuses what cannot be."""

    level: str = parameter(
        "camera",
        unit="-",
        choices=LEVELS,
        read_only=True,
        description="tip: measured tips; camera: images; drive: images and emulated drives.",
    )
    seed: int = parameter(
        0,
        unit="-",
        lower=0,
        upper=2**31 - 1,
        read_only=True,
        description="Keys all chance; the same seed gives the same run in lock step.",
    )
    real_time_factor: float = parameter(
        0.0,
        unit="-",
        lower=0.0,
        upper=100.0,
        read_only=True,
        description="Simulated over real time; 0 is lock step, as fast as the graph answers.",
    )
    curvature: float = parameter(
        1.0 / 0.122,
        unit="1/m",
        lower=0.0,
        upper=100.0,
        read_only=True,
        description="Curvature of the needle's path in this tissue.",
    )
    initial_pitch: float = parameter(
        0.0,
        unit="rad",
        lower=-math.pi / 2,
        upper=math.pi / 2,
        read_only=True,
        description="Pitch of the needle at its entry point.",
    )
    initial_roll: float = parameter(
        0.0,
        unit="rad",
        lower=-math.pi,
        upper=math.pi,
        read_only=True,
        description="Roll of the bevel at the entry point.",
    )
    tip_noise: float = parameter(
        0.001,
        unit="m",
        lower=0.0,
        upper=0.1,
        read_only=True,
        description="Level tip: largest error of each measured coordinate, uniform.",
    )
    torsion_play: float = parameter(
        0.0,
        unit="rad",
        lower=0.0,
        upper=math.pi,
        read_only=True,
        description="Dead band between base and tip angle, either way.",
    )
    torsion_lag: float = parameter(
        0.0,
        unit="m",
        lower=0.0,
        upper=1.0,
        read_only=True,
        description="First-order lag of the tip's angle in inserted length.",
    )
    camera_rate: float = parameter(
        10.0,
        unit="Hz",
        lower=0.1,
        upper=50.0,
        read_only=True,
        description="Exposures per simulated second; lock step exposes when one is due instead.",
    )
    calibration_file: str = parameter(
        "",
        unit="-",
        read_only=True,
        description="Calibration of the simulated cameras; empty: needle_tracker's own.",
    )
    scenario: str = parameter(
        CLEAN.name,
        unit="-",
        choices=tuple(SCENARIOS),
        read_only=True,
        description="What troubles the cameras.",
    )
    images: str = parameter(
        "",
        unit="-",
        read_only=True,
        description="New folder for every image, calibration, insertions and truth; empty: none.",
    )
    wait_for_recorder: bool = parameter(
        False,
        unit="-",
        read_only=True,
        description="Time starts only when a node named recorder listens to everything and all "
        "partners know this node.",
    )
    reexpose_after: float = parameter(
        2.0,
        unit="s",
        lower=0.1,
        upper=60.0,
        read_only=True,
        description="Lock step: expose again when a steered, held needle hears nothing so long.",
    )
    tick_timeout: float = parameter(
        0.5,
        unit="s",
        lower=0.02,
        upper=60.0,
        read_only=True,
        description="Level drive: how long driver and drives may leave a tick unanswered.",
    )
    max_depth: float = parameter(
        SafetyLimits.max_depth,
        unit="m",
        lower=0.001,
        upper=0.5,
        read_only=True,
        description="Deepest insertion.",
    )
    max_step_length: float = parameter(
        SafetyLimits.max_step_length,
        unit="m",
        lower=1e-5,
        upper=HARD_STEP_LENGTH_CAP,
        read_only=True,
        description="Longest insertion of one command.",
    )
    max_speed: float = parameter(
        SafetyLimits.max_speed,
        unit="m/s",
        lower=1e-5,
        upper=HARD_SPEED_CAP,
        read_only=True,
        description="Fastest insertion of a command.",
    )
    max_rotation_step: float = parameter(
        SafetyLimits.max_rotation_step,
        unit="rad",
        lower=0.01,
        upper=2 * math.pi,
        read_only=True,
        description="Largest rotation of one command.",
    )
    max_rotation_rate: float = parameter(
        SafetyLimits.max_rotation_rate,
        unit="rad/s",
        lower=0.01,
        upper=20.0,
        read_only=True,
        description="Fastest rotation of a command.",
    )
    max_turns: float = parameter(
        SafetyLimits.max_turns,
        unit="turns",
        lower=0.1,
        upper=1000.0,
        read_only=True,
        description="Largest rotation either way from home.",
    )
    hold_timeout: float = parameter(
        SafetyLimits.hold_timeout,
        unit="s",
        lower=0.05,
        upper=0.5,
        read_only=True,
        description="A hold message counts so long after its arrival, steady clock.",
    )
    tip_age_limit: float = parameter(
        SafetyLimits.tip_age_limit,
        unit="s",
        lower=0.05,
        upper=60.0,
        read_only=True,
        description="A command is refused if the tip behind it is older, steady clock.",
    )
    retraction_speed: float = parameter(
        SafetyLimits.retraction_speed,
        unit="m/s",
        lower=1e-5,
        upper=HARD_SPEED_CAP,
        read_only=True,
        description="Speed at which the needle is drawn out.",
    )

    def __post_init__(self) -> None:
        """Refuse what cannot be simulated.

        Raises
        ------
        UserError
            A parameter out of bounds, or images wanted of a level that has none.
        """
        check_fields(self)
        if self.level == "tip" and self.scenario != CLEAN.name:
            raise UserError(f"scenario = {self.scenario!r}: level tip has no images")
        if self.level == "tip" and self.images:
            raise UserError(f"images = {self.images!r}: level tip has no images")

    @property
    def limits(self) -> SafetyLimits:
        """The motion supervisor's limits."""
        own = {field.name for field in dataclasses.fields(self)}
        shared = [field.name for field in dataclasses.fields(SafetyLimits) if field.name in own]
        return SafetyLimits(**{name: getattr(self, name) for name in shared})
