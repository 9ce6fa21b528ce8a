"""Count lines of code: by package, and all but tests; `scripts/test` prints it.

`python scripts/lib/code_lines.py [CHECKOUT]` counts another checkout.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
    tokenize.INDENT,
    tokenize.NEWLINE,
    tokenize.NL,
}


def code_lines(source: str) -> int:
    """Return the number of lines with code in a module, without blanks, comments and docstrings."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = node.body[0] if node.body else None
            if ast.get_docstring(node, clean=False) is not None and text is not None:
                lines.difference_update(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    return len(lines)


def modules(root: Path) -> list[Path]:
    """Return all modules in a checkout's packages, scripts and tests."""
    folders = ("ros2_ws/src", "scripts", "tests")
    return sorted(module for folder in folders for module in (root / folder).rglob("*.py"))


def is_test(module: Path, root: Path) -> bool:
    """Return whether a module is part of the tests."""
    return not {"test", "tests"}.isdisjoint(module.relative_to(root).parts)


def count(root: Path) -> Counter[str]:
    """Return the lines of code by package and of the scripts, without tests."""
    lines: Counter[str] = Counter()
    for module in modules(root):
        if not is_test(module, root):
            parts = module.relative_to(root).parts
            lines[parts[2] if parts[0] == "ros2_ws" else parts[0]] += code_lines(
                module.read_text("utf-8")
            )
    return lines


def main() -> None:
    """Print the count of a checkout."""
    lines = count(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT)
    parts = ", ".join(f"{name.removeprefix('needle_')} {lines[name]}" for name in sorted(lines))
    print(f"code lines     {lines.total()} without tests: {parts}")


if __name__ == "__main__":
    main()
