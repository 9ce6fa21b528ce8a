"""The reference has every endpoint, parameter, diagnostic and command line that the code has."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from xml.etree import ElementTree

import pytest
import yaml

from code_lines import ROOT
from needle_core.settings.parameter_fields import specs
from reference.command_pages import commands_page, scripts
from reference.diagnostic_pages import diagnostic_texts
from reference.endpoints import PUBLISHES, SERVES, SOURCES, SUBSCRIBES
from reference.markdown import code
from reference.node_pages import topics_page
from reference.rig_nodes import (
    IN_EVERY_NODE,
    NOT_COMPONENTS,
    RigNode,
    executables,
    rig_nodes,
)

IN_EVERY_BAG = ("/diagnostics", "/rosout", "/parameter_events")


@pytest.fixture(scope="module")
def nodes() -> list[RigNode]:
    return rig_nodes()


def runtime_modules() -> Iterator[tuple[str, ast.Module]]:
    """Yield (path below the package's folder, tree) of all runtime modules."""
    for path in sorted(SOURCES.glob("*/*/**/*.py")):
        package, below, *_ = path.relative_to(SOURCES).parts
        if below == package:
            yield str(path.relative_to(SOURCES / package)), ast.parse(path.read_text("utf-8"))


def test_recorded_topics_are_in_the_reference_with_their_types(nodes: list[RigNode]) -> None:
    page = topics_page(nodes)
    text = (ROOT / "bags/regression/metadata.yaml").read_text("utf-8")
    recorded = yaml.safe_load(text)["rosbag2_bagfile_information"]["topics_with_message_count"]
    known = {
        (end.name if end.name.startswith("/") else f"/{end.name}", end.type_name)
        for node in nodes
        for end, _ in node.endpoints(PUBLISHES)
    }
    for topic in (each["topic_metadata"] for each in recorded):
        name, kind = topic["name"], topic["type"].replace("/msg/", "/")
        # `small_bag` has compressed its images.
        if name.endswith("/compressed") or name in IN_EVERY_BAG:
            continue
        assert (name, kind) in known
        assert code(kind) in page


def test_every_declared_parameter_is_that_of_a_node(nodes: list[RigNode]) -> None:
    fields = {name for node in nodes for name, _, _ in specs(node.parameters)}
    declared = {
        part.target.id
        for _, tree in runtime_modules()
        for part in ast.walk(tree)
        if isinstance(part, ast.AnnAssign)
        and isinstance(part.target, ast.Name)
        and isinstance(part.value, ast.Call)
        and getattr(part.value.func, "id", "") in ("parameter", "fixed_parameter")
    }
    assert declared - fields == set()


def test_every_part_and_message_of_diagnostics_is_listed(nodes: list[RigNode]) -> None:
    parts = {part for node in nodes for part in node.parts} | set(IN_EVERY_NODE)
    for path, tree in runtime_modules():
        for call in ast.walk(tree):
            if not isinstance(call, ast.Call) or getattr(call.func, "attr", "") != "set":
                continue
            if "_diagnostics" in ast.unparse(call.func) and isinstance(call.args[0], ast.Constant):
                assert call.args[0].value in parts, path
    found = diagnostic_texts()
    words = sum(
        part.attr in ("WARN", "ERROR") and getattr(part.value, "id", "") == "Level"
        for path, tree in runtime_modules()
        for part in ast.walk(tree)
        if isinstance(part, ast.Attribute)
    )
    compared = 4  # comparisons `is Level.ERROR`, `>= Level.WARN`, `== ...` without a text
    assert words - compared <= len(found) <= words


def test_the_rows_of_nodes_that_are_not_components_match_their_code() -> None:
    for node in NOT_COMPONENTS:
        source = inspect.getsource(node.module)
        offered = {
            f"{node.name}/{name}" for name in re.findall(r'create_service\(.*"~/(\w+)"', source)
        }
        assert {end.name for end, _ in node.endpoints(SERVES)} == offered
        for part, keys in node.parts.items():
            assert all(f'"{word}"' in source for word in (part, *keys))


def test_every_command_line_is_listed(nodes: list[RigNode]) -> None:
    page = commands_page(nodes)
    commands = [name for _, name, _ in executables("command")]
    assert {node.name for node in nodes} == {name for _, name, _ in executables("node")}
    for name in (*commands, *(f"scripts/{script}" for script in scripts())):
        _, heading, text = page.partition(f"### {name}\n")
        assert heading, name
        assert "usage: " in text.partition("\n###")[0], name


def test_the_diagram_of_the_graph_matches_the_nodes(nodes: list[RigNode]) -> None:
    picture = ElementTree.parse(ROOT / "docs/images/graph.svg")
    by_name = {node.name: node for node in nodes}
    arrows = [part.attrib for part in picture.iter() if "data-topics" in part.attrib]
    assert len(arrows) == 5
    for arrow in arrows:
        publisher, subscriber = by_name[arrow["data-from"]], by_name[arrow["data-to"]]
        topics = set(arrow["data-topics"].split())
        assert topics <= {end.name for end, _ in publisher.endpoints(PUBLISHES)}
        assert topics <= {end.name for end, _ in subscriber.endpoints(SUBSCRIBES)}
