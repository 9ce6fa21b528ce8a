"""A parameter file that names a node which does not exist is refused, or that is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_common.errors import UserError
from needle_common.settings.parameter_files import foreign_nodes


def given(path: Path, text: str, *more: str) -> list[str]:
    path.write_text(text)
    return foreign_nodes(["node", "--ros-args", "--params-file", str(path), *more])


@pytest.mark.parametrize(
    "text",
    [
        "plane_controller: {ros__parameters: {depth: 0.1}}",
        "/plane_controller: {ros__parameters: {depth: 0.1}}",
        "/left/plane_controller: {ros__parameters: {depth: 0.1}}",
        "left: {plane_controller: {ros__parameters: {depth: 0.1}}}",
        "/**: {ros__parameters: {use_sim_time: true}}",
        "/**/sim_rig: {ros__parameters: {seed: 1}}",
        "",
    ],
)
def test_known_nodes_pass_in_any_way_of_writing(tmp_path: Path, text: str) -> None:
    assert given(tmp_path / "p.yaml", text) == []


@pytest.mark.parametrize(
    "text",
    [
        "controller: {ros__parameters: {depth: 0.1}}",
        "sim_rig: {ros__parameters: {seed: 1}}\ncontroller: {ros__parameters: {depth: 0.1}}",
        "/left/controller: {ros__parameters: {depth: 0.1}}",
    ],
)
def test_a_misspelt_node_is_named_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(
        UserError,
        match=r"p\.yaml: unknown node '.*controller', did you mean 'plane_controller'\?",
    ) as caught:
        given(tmp_path / "p.yaml", text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["joy_node", "/bench/camera", "foxglove_bridge", "rviz"])
def test_a_file_may_be_shared_with_other_nodes_which_is_said(tmp_path: Path, name: str) -> None:
    text = f"sim_rig: {{ros__parameters: {{seed: 1}}}}\n{name}: {{ros__parameters: {{x: 1}}}}"
    [line] = given(tmp_path / "p.yaml", text)
    assert "no nodes of this rig" in line
    assert name in line


def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"p\.yaml: not YAML in line 1"):
        given(tmp_path / "p.yaml", "[1, 2")
    path = tmp_path / "none.yaml"
    with pytest.raises(UserError, match=r"none\.yaml: cannot be read: No such file or directory$"):
        foreign_nodes(["node", "--ros-args", "--params-file", str(path)])


def test_a_renamed_node_is_known(tmp_path: Path) -> None:
    text = "sim_rigs: {ros__parameters: {seed: 1}}"
    assert given(tmp_path / "p.yaml", text, "-r", "__node:=sim_rigs") == []
