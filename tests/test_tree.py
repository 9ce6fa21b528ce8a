"""The shape of the tree: modules and folders of a size to be read, and the counter of lines."""

from __future__ import annotations

import ast
from collections import Counter
from types import SimpleNamespace
from typing import cast

import pytest

from code_lines import ROOT, code_lines, is_test, modules
from pytest_lanes import BACKGROUND_LIMIT, LONG_FILES, next_file, pytest_collection_modifyitems

LONGEST_MODULE = 400
MOST_MODULES = 15
NODES = "ros2_ws/src/needle_bags/test/ros/test_recorder.py"
MORE_NODES = "ros2_ws/src/needle_bags/test/ros/test_player.py"
RECKONS = "ros2_ws/src/needle_tracker/test/image/test_looks.py"
MORE = "ros2_ws/src/needle_tracker/test/image/test_tip_fit.py"
# Docstrings begin with a noun or a verb, not with a clause.
CLAUSES = {"How", "Nobody", "What", "When", "Where", "Who", "Whoever", "Whose", "Why"}
SOURCE = '''"""A docstring.

Of three lines.
"""

# A comment
X = """A value
of two lines"""


def double(x: int) -> int:  # beside code
    """Return twice x."""

    return (
        # a comment within
        2 * x
    )


class Empty:
    """Nothing but a docstring."""
'''


def test_a_line_of_code_is_no_blank_comment_or_docstring() -> None:
    assert code_lines(SOURCE) == 2 + 1 + 3 + 1


def test_no_module_is_too_long_to_be_read_at_once() -> None:
    long = {
        str(module.relative_to(ROOT)): length
        for module in modules(ROOT)
        if (length := len(module.read_text("utf-8").splitlines())) > LONGEST_MODULE
    }
    assert not long


def test_no_folder_holds_too_many_modules_to_be_found_in() -> None:
    folders = Counter(module.parent for module in modules(ROOT) if module.name != "__init__.py")
    full = {
        str(folder.relative_to(ROOT)): number
        for folder, number in folders.items()
        if number > MOST_MODULES
    }
    assert not full


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    clauses = [
        f"{module.relative_to(ROOT)}: {text}"
        for module in modules(ROOT)
        if not is_test(module, ROOT)
        for node in ast.walk(ast.parse(module.read_text("utf-8")))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if (text := (ast.get_docstring(node) or "").partition("\n")[0]).partition(" ")[0] in CLAUSES
    ]
    assert clauses == []


def test_the_test_files_that_are_run_first_are_there() -> None:
    assert [name for name in LONG_FILES if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize(
    ("waiting", "in_front", "next_one"),
    [
        ([NODES, RECKONS], True, NODES),
        ([RECKONS, NODES, MORE_NODES], True, NODES),
        ([NODES, RECKONS, MORE], False, RECKONS),
        ([RECKONS, MORE], True, RECKONS),
        ([NODES, MORE_NODES], False, None),
    ],
)
def test_a_lane_gets_what_it_may_run(
    waiting: list[str], in_front: bool, next_one: str | None
) -> None:
    assert next_file(waiting, in_front=in_front) == next_one


def test_who_makes_way_for_others_has_time(request: pytest.FixtureRequest) -> None:
    for file, limit in (
        ("ros2_ws/src/needle_tracker/test/calibrating/test_box_calibration.py", BACKGROUND_LIMIT),
        ("tests/test_tree.py", 300.0),
    ):
        item = pytest.Function.from_parent(request.node.parent, name="test", callobj=lambda: None)
        item.add_marker(pytest.mark.timeout(300.0))
        placed = SimpleNamespace(nodeid=f"{file}::test", add_marker=item.add_marker)
        pytest_collection_modifyitems([cast(pytest.Item, placed)])
        marker = item.get_closest_marker("timeout")
        assert marker is not None and marker.args == (limit,)
