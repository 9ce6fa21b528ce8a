"""The parameters of stereo_tracker."""

from __future__ import annotations

import dataclasses

from needle_common.errors import UserError
from needle_common.parameter_fields import check_fields, parameter
from needle_tracker.calibration import Phantom
from needle_tracker.gates import GateSettings
from needle_tracker.pair_answers import AnsweringSettings
from needle_tracker.search_grid import Reach
from needle_tracker.tracker_settings import TrackerSettings


@dataclasses.dataclass(frozen=True)
class StereoTrackerParameters:
    """Parameters of the node; all are fixed at start, so that a run is of one piece."""

    calibration_file: str = parameter(
        "",
        unit="-",
        description="Calibration file of the stereo rig; empty: the simulated bench's.",
        read_only=True,
    )
    reliable_images: bool = parameter(
        True,
        unit="-",
        description="Take images reliably, for simulation; false: best effort, for hardware.",
        read_only=True,
    )
    pair_tolerance: float = parameter(
        0.0,
        unit="s",
        description="Largest difference of the stamps of a left and a right image of one pair.",
        lower=0.0,
        upper=0.1,
        read_only=True,
    )
    joint_timeout: float = parameter(
        1.0,
        unit="s",
        description="How long a pair waits for the joint state that follows it (steady clock).",
        lower=0.0,
        upper=60.0,
        read_only=True,
    )
    wait_for_recorder: bool = parameter(
        False,
        unit="-",
        description="Take images only when a node named recorder listens to what is found, and "
        "those who publish joints and estimates know this node.",
        read_only=True,
    )
    needle_width: float = parameter(
        0.7e-3,
        unit="m",
        description="Diameter of the needle.",
        lower=0.2e-3,
        upper=3e-3,
        read_only=True,
    )
    needle_polarity: str = parameter(
        "auto",
        unit="-",
        description="Whether the needle is darker or brighter than what is around it; auto: found.",
        choices=("auto", "dark", "bright"),
        read_only=True,
    )
    min_contrast: float = parameter(
        10.0,
        unit="-",
        description="Least contrast of the needle that counts [grey levels].",
        lower=1.0,
        upper=255.0,
        read_only=True,
    )
    noise_factor: float = parameter(
        5.0,
        unit="-",
        description="Detection threshold in standard deviations of the images' noise.",
        lower=1.0,
        upper=50.0,
        read_only=True,
    )
    entry_zone: float = parameter(
        4.5e-3,
        unit="m",
        description="Insertion below which the tip is taken from the insertion, not looked for.",
        lower=0.0,
        upper=0.05,
        read_only=True,
    )
    hole_clearance: float = parameter(
        2.0e-3,
        unit="m",
        description="Radius about the entry point that is not looked at (hole, rim).",
        lower=0.5e-3,
        upper=0.02,
        read_only=True,
    )
    hole_tolerance: float = parameter(
        0.5e-3,
        unit="m",
        description="How far from the entry point the needle may pass.",
        lower=0.01e-3,
        upper=5e-3,
        read_only=True,
    )
    entry_angle: float = parameter(
        0.1745,
        unit="rad",
        description="Largest angle of the needle to rig's z at the entry.",
        lower=0.0,
        upper=0.7,
        read_only=True,
    )
    max_curvature: float = parameter(
        9.0,
        unit="1/m",
        description="Largest curvature of the needle's path.",
        lower=0.1,
        upper=50.0,
        read_only=True,
    )
    max_insertion: float = parameter(
        0.15,
        unit="m",
        description="Longest insertion; nothing is looked for farther from the entry.",
        lower=0.01,
        upper=1.0,
        read_only=True,
    )
    tip_lean: float = parameter(
        0.21,
        unit="rad",
        description="Largest angle between the visible end and the needle's path (pre-bend).",
        lower=0.0,
        upper=0.8,
        read_only=True,
    )
    lean: float = parameter(
        0.0977,
        unit="rad",
        description="Angle between heading and visible end; taken off with heading_from_estimate.",
        lower=0.0,
        upper=0.7,
        read_only=True,
    )
    heading_from_estimate: bool = parameter(
        False,
        unit="-",
        description="Publish the heading (lean taken off) where needle/estimate knows the roll.",
        read_only=True,
    )
    annotated_rate: float = parameter(
        2.0,
        unit="Hz",
        description="Most annotated images per second, while someone subscribes; 0: none.",
        lower=0.0,
        upper=100.0,
        read_only=True,
    )
    insertion_margin: float = parameter(
        2.0e-3,
        unit="m",
        description="Tolerance between the tip's distance from the entry and the insertion.",
        lower=0.1e-3,
        upper=0.05,
        read_only=True,
    )
    step_margin: float = parameter(
        1.0e-3,
        unit="m",
        description="Tolerance of the tip against where the last tip and the insertion have it.",
        lower=0.1e-3,
        upper=0.05,
        read_only=True,
    )
    free_step: float = parameter(
        5.0e-3,
        unit="m",
        description="Largest move of the tip per pair where the insertion is not known.",
        lower=0.1e-3,
        upper=0.1,
        read_only=True,
    )
    max_disagreement: float = parameter(
        1.5e-3,
        unit="m",
        description="Largest disagreement of the cameras about the end along the needle.",
        lower=0.05e-3,
        upper=0.05,
        read_only=True,
    )
    confirm_pairs: int = parameter(
        3,
        unit="-",
        description="Pairs in a row that must agree, where the insertion is not known.",
        lower=1,
        upper=100,
        read_only=True,
    )
    lost_after: int = parameter(
        10,
        unit="-",
        description="Pairs in a row without a tip after which the track is lost.",
        lower=1,
        upper=1000,
        read_only=True,
    )
    forget_after: int = parameter(
        30,
        unit="-",
        description="Pairs in a row without a tip after which the last place no longer counts.",
        lower=1,
        upper=10000,
        read_only=True,
    )

    def __post_init__(self) -> None:
        """Check the fields, and what holds between them."""
        check_fields(self)
        if self.hole_clearance >= self.max_insertion:
            raise UserError(
                f"hole_clearance = {self.hole_clearance:g} m is not below "
                f"max_insertion = {self.max_insertion:g} m"
            )
        if self.lost_after > self.forget_after:
            raise UserError(
                f"lost_after = {self.lost_after} is above forget_after = {self.forget_after}"
            )

    def answering_settings(self) -> AnsweringSettings:
        """Return how pairs are made and answered."""
        return AnsweringSettings(
            pair_tolerance_ns=round(self.pair_tolerance * 1e9),
            joint_timeout=self.joint_timeout,
            lean=self.lean,
        )

    def tracker_settings(self, phantom: Phantom) -> TrackerSettings:
        """Return the settings of the tracker behind the node.

        Parameters
        ----------
        phantom : Phantom
            From the calibration.

        Returns
        -------
        TrackerSettings
            As the parameters say.
        """
        gates = GateSettings(
            reach=Reach(
                self.max_curvature, self.entry_angle, self.hole_tolerance, self.max_insertion
            ),
            surface_height=phantom.surface_height,
            least_distance=self.hole_clearance + 1.5e-3,
            tip_lean=self.tip_lean,
            insertion_margin=self.insertion_margin,
            step_margin=self.step_margin,
            free_step=self.free_step,
            max_disagreement=self.max_disagreement,
            max_miss_px=1.0,
            max_depth_sigma=0.5e-3,
            confirm_pairs=self.confirm_pairs,
            lost_after=self.lost_after,
            forget_after=self.forget_after,
        )
        return TrackerSettings(
            gates=gates,
            needle_width=self.needle_width,
            bright=None if self.needle_polarity == "auto" else self.needle_polarity == "bright",
            min_contrast=self.min_contrast,
            noise_factor=self.noise_factor,
            entry_zone=self.entry_zone,
            hole_clearance=self.hole_clearance,
        )
