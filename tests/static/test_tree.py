"""Size of modules and folders, docstrings, base classes of nodes, and the counter of code lines."""

from __future__ import annotations

import ast
from collections import Counter

from code_lines import ROOT, code_lines, is_test, modules

LONGEST_MODULE = 400
MOST_MODULES = 15
# Docstrings begin with a noun or a verb, not with a clause.
CLAUSES = {"How", "Nobody", "What", "When", "Where", "Who", "Whoever", "Whose", "Why"}
RCLPY = {"Node", "LifecycleNode"}
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


def test_blank_lines_comments_and_docstrings_are_not_code() -> None:
    assert code_lines(SOURCE) == 2 + 1 + 3 + 1


def test_no_module_is_too_long() -> None:
    long = {
        str(module.relative_to(ROOT)): length
        for module in modules(ROOT)
        if (length := len(module.read_text("utf-8").splitlines())) > LONGEST_MODULE
    }
    assert not long


def test_no_folder_has_too_many_modules() -> None:
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


def test_no_node_derives_from_rclpy_directly() -> None:
    # Its own base class destroys a node whose construction fails.
    found = []
    for path in sorted((ROOT / "ros2_ws" / "src").glob("*/*/ros/*.py")):
        if "test" in path.parts or path.name == "base_node.py":
            continue
        for part in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(part, ast.ClassDef):
                bases = {base.id for base in part.bases if isinstance(base, ast.Name)}
                if bases & RCLPY:
                    found.append(f"{path.relative_to(ROOT)}: {part.name}")
    assert found == []
