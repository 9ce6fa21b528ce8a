"""Parameters reach the node, or stop it with one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_core.settings.parameter_files import (
    check_command_line,
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
    words = ["/lib/device_driver", "--ros-args", "--params-file", str(file), *more]
    return check_command_line(words, node)


@pytest.mark.parametrize(
    ("text", "node"),
    [
        (DRIVES, "/device_driver"),
        (f"/{DRIVES}", "/device_driver"),
        (f"/rig1/{DRIVES}", "/rig1/device_driver"),
        (f"rig1/{DRIVES}", "/rig1/device_driver"),
        ("rig1: {device_driver: {ros__parameters: {max_depth: 0.08}}}", "/rig1/device_driver"),
        (BOTH_RIGS, "/rig1/device_driver"),
        (BOTH_RIGS, "/rig2/device_driver"),
        (f"/**/{DRIVES}", "/a/b/device_driver"),
        (f"/a/*/{DRIVES}", "/a/b/device_driver"),
        ("/**: {ros__parameters: {max_depth: 0.08}}", "/a/b/other"),
        ("/rig1/**: {ros__parameters: {max_depth: 0.08}}", "/rig1/other"),
        ("other: {ros__parameters: {max_depth: 0.08}}", "/other"),
        (f"{DRIVES}\n/rig1/{DRIVES}", "/rig1/device_driver"),
        (f"{DRIVES}\njoy_node: {{ros__parameters: {{rate: 50.0}}}}", "/device_driver"),
    ],
)
def test_a_section_for_the_node_reaches_it(file: Path, text: str, node: str) -> None:
    assert checked(file, text, node) == []


@pytest.mark.parametrize(
    ("text", "node", "section"),
    [
        (DRIVES, "/rig1/device_driver", "device_driver"),
        (DRIVES, "/other", "device_driver"),
        (DRIVES, "/rig1/other", "device_driver"),
        (f"/rig2/{DRIVES}", "/rig1/device_driver", "/rig2/device_driver"),
        (f"/*/{DRIVES}", "/a/b/device_driver", "/*/device_driver"),
        (f"/*/{DRIVES}", "/device_driver", "/*/device_driver"),
        (BOTH_RIGS, "/rig3/device_driver", "/rig1/device_driver"),
        (
            "rig2: {device_driver: {ros__parameters: {}}}",
            "/rig1/device_driver",
            "rig2/device_driver",
        ),
        ("other: {ros__parameters: {max_depth: 0.08}}", "/rig1/other", "other"),
        ("/rig2/**: {ros__parameters: {max_depth: 0.08}}", "/rig1/device_driver", "/rig2/**"),
        # What is for all nodes is not what was written for this kind of node.
        (f"/**: {{ros__parameters: {{}}}}\n{DRIVES}", "/rig1/device_driver", "device_driver"),
    ],
)
def test_sections_of_which_none_reaches_it_stop_the_node(
    file: Path, text: str, node: str, section: str
) -> None:
    with pytest.raises(UserError) as caught:
        checked(file, text, node)
    meant = section if section.startswith("/") else f"/{section}"
    assert str(caught.value) == (
        f"{file}: section '{section}' is for {meant}, this node is {node}: "
        f"write '{node}', '/**/{node.rpartition('/')[2]}' or '/**'"
    )


@pytest.mark.parametrize(
    "text", ["joy_node: {ros__parameters: {a: 1}}", "/rig1/sim_rig: {ros__parameters: {}}", ""]
)
def test_a_file_for_other_nodes_only_is_one_warning(file: Path, text: str) -> None:
    named = text.partition(":")[0] or "none"
    warning = f"{file}: no section for /rig1/device_driver: it has {named}"
    assert checked(file, text, "/rig1/device_driver") == [warning]


@pytest.mark.parametrize("name", ["device_drivr", "/rig1/device_drivr", "plane_controler"])
def test_a_misspelt_node_is_named(file: Path, name: str) -> None:
    with pytest.raises(UserError, match=f"unknown node '{name}', did you mean '(device|plane)_"):
        checked(file, f"{name}: {{ros__parameters: {{a: 1}}}}", "/rig1/device_driver")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{DRIVES}\nsim_rig: {{}}\n{DRIVES}", "duplicate key 'device_driver' in line 3"),
        ("a:\n  ros__parameters:\n    x: 1\n    x: 2", "duplicate key 'x' in line 4"),
        (
            "a: {ros__parameters: {x: 1}, ros__parameters: {y: 1}}",
            "duplicate key 'ros__parameters'",
        ),
        (f"{DRIVES}\n/{DRIVES}", "'/device_driver' stands there twice"),
        (f"rig1: {{{DRIVES}}}\n/rig1/{DRIVES}", "'/rig1/device_driver' stands there twice"),
        ("a: {ros__parameters: {x.y: 1, x: {y: 2}}}", "a: 'x.y' stands there twice"),
        ("[1, 2", "not YAML in line 2"),
        ("just text", "not a ROS parameter file"),
        ("a: {ros_parameters: {x: 1}}", "'a/ros_parameters/x' stands outside ros__parameters"),
        ("a: {ros__parameters: [1]}", "'a/ros__parameters' wants NAME: VALUE pairs"),
    ],
)
def test_what_is_no_parameter_file_is_named_in_one_line(file: Path, text: str, words: str) -> None:
    file.write_text(text)
    with pytest.raises(UserError) as caught:
        read_sections(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(file: Path) -> None:
    with pytest.raises(UserError, match=r"drives\.yaml: cannot be read: No such file or directory"):
        read_sections(file)


def test_an_override_for_another_name_stops_the_node(file: Path) -> None:
    words = ("-p", "device_driver:max_depth:=0.06")
    assert checked(file, "/**: {ros__parameters: {}}", "/device_driver", *words) == []
    with pytest.raises(UserError, match=r"-p device_driver:max_depth:=0\.06: section 'device_dri"):
        checked(file, "/**: {ros__parameters: {}}", "/rig1/device_driver", *words)


@pytest.mark.parametrize("before", ["/**: {ros__parameters: {use_sim_time: false}}\n", ""])
def test_an_override_that_ros_puts_below_a_file_stops_the_node(file: Path, before: str) -> None:
    words = ("-p", "max_depth:=0.06")
    if not before:
        assert checked(file, DRIVES, "/device_driver", *words) == []
        return
    with pytest.raises(UserError) as caught:
        checked(file, before + DRIVES, "/device_driver", *words)
    assert str(caught.value).startswith(
        f"-p max_depth:=0.06 does not reach /device_driver, section 'device_driver' of {file} wins:"
    )
    assert checked(file, f"{DRIVES}\n{before}", "/device_driver", *words) == []


def test_nodes_that_start_together_get_what_is_theirs(file: Path) -> None:
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
