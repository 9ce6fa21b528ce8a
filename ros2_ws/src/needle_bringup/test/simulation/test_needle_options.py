"""One needle in all nodes: options set them alike, and what contradicts is said."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest

from needle_bringup.simulation.needle_options import (
    CURVATURE,
    PRE_BEND,
    SHARED,
    contradictions,
    needle_parameters,
)
from needle_bringup.simulation.rig_configuration import NODES, command_line_parameters, merge
from needle_bringup.simulation.simulate_options import parse
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.errors import UserError
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.answers.tracker_parameters import StereoTrackerParameters

CLASSES: dict[str, type[Any]] = {
    "sim_rig": SimRigParameters,
    "stereo_tracker": StereoTrackerParameters,
    "plane_controller": SteeringSettings,
}


def test_the_defaults_are_those_of_the_nodes() -> None:
    for shared in SHARED:
        for node, name in shared.places:
            default = getattr(CLASSES[node](), name)
            tolerance = 2e-4  # rad: the tracker's lean is rounded
            assert default == (
                pytest.approx(shared.default, abs=tolerance)
                if isinstance(shared.default, float)
                else shared.default
            ), (node, name)
    assert SimRigParameters().pre_bend == pytest.approx(PRE_BEND)
    assert contradictions({}, NODES) == []


def test_the_options_of_a_needle_set_every_node_alike() -> None:
    words = "--curvature 5 --diameter-mm 1.2 --pre-bend-deg 6"
    told = command_line_parameters(parse(words.split()), Path("bag"))
    nodes = {
        node: kind(**{k: v for k, v in told[node].items() if k in names_of(kind)})
        for node, kind in CLASSES.items()
    }
    for shared in SHARED:
        values = [getattr(nodes[node], name) for node, name in shared.places]
        assert len(set(values)) == 1, shared
    assert nodes["sim_rig"].curvature == 5.0
    assert nodes["sim_rig"].needle_diameter == pytest.approx(0.0012)
    assert nodes["sim_rig"].pre_bend == pytest.approx(math.radians(6.0))
    assert nodes["sim_rig"].pre_bend_lean < nodes["sim_rig"].pre_bend
    assert nodes["stereo_tracker"].max_curvature > 5.0
    assert nodes["stereo_tracker"].tip_lean > nodes["stereo_tracker"].lean
    assert contradictions(told, NODES) == []


def names_of(kind: type[Any]) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def test_what_continuous_insertion_sets_stays_beside_a_needle() -> None:
    told = command_line_parameters(
        parse(["--insertion", "continuous", "--curvature", "5", "--target", "1,2,60"]), Path("bag")
    )
    assert told["sim_rig"]["camera_rate"] > 10.0
    assert told["plane_controller"]["target_point"] == pytest.approx([0.001, 0.002, 0.06])
    assert "needle_width" not in told["stereo_tracker"]


def test_a_straight_needle_is_one() -> None:
    told = needle_parameters(None, None, 0.0)["sim_rig"]
    assert SimRigParameters(**told).needle == NeedleShape(bend_angle=0.0, lean=0.0)


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ({"sim_rig": {"curvature": 6.0}}, "sim_rig has curvature 6 1/m, plane_controller has"),
        ({"plane_controller": {"curvature": 6.0}}, "--curvature sets it in all nodes"),
        ({"stereo_tracker": {"needle_width": 0.001}}, "needle_width 0.001 m"),
        ({"sim_rig": {"pre_bend_lean": 0.05}}, "lean of the needle's end differs"),
        ({"sim_rig": {"calibration_file": "mine.yaml"}}, "stereo_tracker has calibration_file ''"),
    ],
)
def test_a_file_that_contradicts_other_nodes_is_told(
    file: dict[str, dict[str, Any]], said: str
) -> None:
    parameters = merge(command_line_parameters(parse([]), Path("bag")), file)
    (line,) = contradictions(parameters, NODES)
    assert said in line


def test_a_needle_that_the_tracker_does_not_look_for_is_told() -> None:
    told = {node: {"curvature": 12.0} for node in ("sim_rig", "plane_controller")}
    (line,) = contradictions(told, NODES)
    assert line == "sim_rig has curvature 12, but stereo_tracker looks for max_curvature 9"
    assert contradictions(told, ("sim_rig", "plane_controller")) == []
    assert contradictions({"sim_rig": {"curvature": CURVATURE * (1 + 1e-6)}}, NODES) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--curvature 0", "--curvature = 0 1/m is outside"),
        ("--diameter-mm 5", "--diameter-mm = 5 mm is outside"),
        ("--pre-bend-deg x", "--pre-bend-deg 'x' is not a number"),
    ],
)
def test_a_needle_that_cannot_be_is_refused(words: str, said: str) -> None:
    with pytest.raises(UserError) as error:
        parse(words.split())
    assert said in str(error.value)
