"""Parameters take effect in the node, or stop it with one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_core.settings.parameter_files import (
    check_command_line,
    matching_sections,
    read_parameters,
    read_sections,
)

DRIVES = "device_driver: {ros__parameters: {max_depth: 0.08}}"
BOTH_RIGS = """
/rig1/device_driver: {ros__parameters: {max_depth: 0.08}}
/rig2/device_driver: {ros__parameters: {max_depth: 0.06}}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "drives.yaml"


def checked(file: Path, text: str, node: str, *more: str) -> list[str]:
    """Check the command line of a node that was started as device_driver."""
    file.write_text(text)
    argv = ["/lib/device_driver", "--ros-args", "--params-file", str(file), *more]
    return check_command_line(argv, node)


def test_sections_for_other_names_stop_the_node(file: Path) -> None:
    for text, node, section in (
        (DRIVES, "/rig1/device_driver", "device_driver"),
        (BOTH_RIGS, "/rig3/device_driver", "/rig1/device_driver"),
        # A section for all nodes does not count as one for this kind of node.
        (f"/**: {{ros__parameters: {{}}}}\n{DRIVES}", "/rig1/device_driver", "device_driver"),
    ):
        with pytest.raises(UserError) as caught:
            checked(file, text, node)
        assert f"{file}: section '{section}" in str(caught.value)
        assert f"this node is {node}: write '{node}', '/**/device_driver'" in str(caught.value)


def test_a_file_for_other_nodes_only_is_one_warning(file: Path) -> None:
    for text in ("joy_node: {ros__parameters: {a: 1}}", "/rig1/sim_rig: {ros__parameters: {}}", ""):
        named = text.partition(":")[0] or "none"
        warning = f"{file}: no section for /rig1/device_driver: it has {named}"
        assert checked(file, text, "/rig1/device_driver") == [warning]


def test_a_misspelt_node_is_named(file: Path) -> None:
    for name in ("/rig1/device_drivr", "plane_controler"):
        with pytest.raises(UserError, match=f"unknown node '{name}', did you mean '"):
            checked(file, f"{name}: {{ros__parameters: {{a: 1}}}}", "/rig1/device_driver")


def test_a_file_that_is_not_a_parameter_file_is_a_one_line_error(file: Path) -> None:
    for text, message in (
        (f"{DRIVES}\nsim_rig: {{}}\n{DRIVES}", "duplicate key 'device_driver' in line 3"),
        (f"{DRIVES}\n/{DRIVES}", "'/device_driver' is a duplicate"),
        ("a: {ros__parameters: {x.y: 1, x: {y: 2}}}", "a: 'x.y' is a duplicate"),
        ("just text", "not a ROS parameter file"),
        ("a: {ros_parameters: {x: 1}}", "'a/ros_parameters/x' is outside ros__parameters"),
        ("a: {ros__parameters: [1]}", "'a/ros__parameters' needs NAME: VALUE pairs"),
    ):
        file.write_text(text)
        with pytest.raises(UserError) as caught:
            read_sections(file)
        assert str(caught.value).startswith(f"{file}: ")
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_an_override_that_ros_puts_below_a_file_stops_the_node(file: Path) -> None:
    argv, every = ("-p", "max_depth:=0.06"), "/**: {ros__parameters: {use_sim_time: false}}"
    for reaches in (DRIVES, f"{DRIVES}\n{every}"):
        assert checked(file, reaches, "/device_driver", *argv) == []
    with pytest.raises(UserError) as caught:
        checked(file, f"{every}\n{DRIVES}", "/device_driver", *argv)
    assert str(caught.value).startswith(
        "-p max_depth:=0.06 does not reach /device_driver, section 'device_driver' of "
        f"{file} overrides it:"
    )


def test_nodes_that_start_together_get_their_own_parameters(file: Path) -> None:
    file.write_text(f"{BOTH_RIGS}\n/**: {{ros__parameters: {{rate: 5.0}}}}")
    nodes = ("device_driver", "sim_rig")
    assert read_parameters(file, nodes, "rig2") == {
        "device_driver": {"max_depth": 0.06, "rate": 5.0},
        "sim_rig": {"rate": 5.0},
    }
    with pytest.raises(UserError, match="'/rig1/device_driver' is for /rig1/device_driver, this"):
        read_parameters(file, nodes, "/rig3/")
    with pytest.raises(UserError, match="'/rig1/device_driver' is not started here, only sim_rig"):
        read_parameters(file, ("sim_rig",), "rig2")


# Sections of a file, and by their index those that rcl gives to nodes of these names and kind.
SECTIONS = (
    *("device_driver", "/device_driver", "other", "/rig1/device_driver", "rig1/device_driver"),
    *("/rig1/other", "/rig2/device_driver", "/a/b/device_driver", "/**", "/*", "/*/*", "/rig1/*"),
    *("/rig1/**", "/a/**", "/**/device_driver", "/**/other", "/*/device_driver", "**", "/**/b/*"),
    *("/rig1/**/device_driver", "/**/rig1/device_driver", "/a/*/device_driver", "**/device_driver"),
)
REACHED = {
    "/device_driver": (0, 1, 8, 9, 14, 17, 22),
    "/rig1/device_driver": (3, 4, 8, 10, 11, 12, 14, 16, 17, 19, 20, 22),
    "/a/b/device_driver": (7, 8, 13, 14, 17, 18, 21, 22),
    "/other": (2, 8, 9, 15, 17),
    "/rig1/other": (5, 8, 10, 11, 12, 15, 17),
}


@pytest.mark.parametrize("node", REACHED)
def test_the_sections_reach_a_node_that_rcl_gives_it(node: str) -> None:
    sections: dict[str, dict[str, int]] = {name: {} for name in SECTIONS}
    reached = matching_sections("", sections, node, "device_driver")
    assert [SECTIONS.index(name) for name in reached] == list(REACHED[node])
