"""docs/equations.md lists exactly the equations that the code cites."""

from __future__ import annotations

import ast
import importlib
import io
import re
import tokenize
from collections.abc import Iterator

import pytest

from code_lines import ROOT
from reference.endpoints import SOURCES

PAGE = ROOT / "docs" / "equations.md"
# Packages that implement the paper.
PACKAGES = ("needle_controller", "needle_sim")
# "(7)", "(6)-(8)"; neither "SE(3)" nor "25(1)".
CITED = re.compile(r"(?<![\w.])\((\d{1,2})\)(?:-\((\d{1,2})\))?")
NAME = re.compile(r"`(needle_\w+(?:\.\w+)+)`")


def texts_of(source: str) -> Iterator[str]:
    """Yield the docstrings and comments of a module."""
    for part in ast.walk(ast.parse(source)):
        if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant):
            yield str(part.value.value)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string


def cited(text: str) -> set[int]:
    return {
        number
        for first, last in CITED.findall(text)
        for number in range(int(first), int(last or first) + 1)
    }


def by_code() -> dict[int, set[str]]:
    found: dict[int, set[str]] = {}
    for package in PACKAGES:
        for path in (SOURCES / package / package).rglob("*.py"):
            module = ".".join(path.relative_to(SOURCES / package).with_suffix("").parts)
            for text in texts_of(path.read_text("utf-8")):
                for number in cited(text):
                    found.setdefault(number, set()).add(module)
    return found


def by_page() -> dict[int, list[str]]:
    _, *parts = re.split(r"^## \((\d+)\).*$", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    return {
        int(number): NAME.findall(text)
        for number, text in zip(parts[::2], parts[1::2], strict=True)
    }


def module_of(name: str) -> str:
    """Return the existing module of a name on the page."""
    parts = name.split(".")
    for length in range(len(parts), 1, -1):
        module = ".".join(parts[:length])
        if (SOURCES / parts[0] / f"{module.replace('.', '/')}.py").is_file():
            thing = importlib.import_module(module)
            for attribute in parts[length:]:
                thing = getattr(thing, attribute)
            return module
    raise AssertionError(name)


def test_citations_are_distinguished_from_other_brackets() -> None:
    text = "On SE(3), IEEE 25(1), shape (3,): (6)-(8) and [KC09] (2), the inverse of (10)"
    assert cited(text) == {2, 6, 7, 8, 10}


@pytest.mark.parametrize("number", range(1, 11))
def test_the_page_names_the_modules_that_cite_an_equation(number: int) -> None:
    assert {module_of(name) for name in by_page()[number]} == by_code()[number]


def test_no_other_equation_is_cited() -> None:
    assert set(by_code()) == set(by_page()) == set(range(1, 11))
