"""A parameter file that names a node which does not exist is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_common.errors import UserError
from needle_common.parameter_files import refuse_unknown_nodes


def given(path: Path, text: str, *more: str) -> None:
    path.write_text(text)
    refuse_unknown_nodes(["node", "--ros-args", "--params-file", str(path), *more])


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
        "[1, 2",
    ],
)
def test_known_nodes_pass_in_any_way_of_writing(tmp_path: Path, text: str) -> None:
    given(tmp_path / "p.yaml", text)


@pytest.mark.parametrize(
    "text",
    [
        "controller: {ros__parameters: {depth: 0.1}}",
        "sim_rig: {ros__parameters: {seed: 1}}\ncontroller: {ros__parameters: {depth: 0.1}}",
        "/left/controller: {ros__parameters: {depth: 0.1}}",
    ],
)
def test_an_unknown_node_is_named_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(
        UserError, match=r"p\.yaml: unknown node '.*controller' \(known: "
    ) as caught:
        given(tmp_path / "p.yaml", text)
    assert "\n" not in str(caught.value)


def test_a_renamed_node_is_known(tmp_path: Path) -> None:
    given(tmp_path / "p.yaml", "other: {ros__parameters: {seed: 1}}", "-r", "__node:=other")
