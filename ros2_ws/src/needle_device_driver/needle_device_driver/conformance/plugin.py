"""Options of the conformance kit for pytest, and its table of rules by drive."""

from __future__ import annotations

from typing import Any

import pytest

ROW = "rule by drive"
"""Property of a test: drive, rule and verdict."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("needle_device_driver.conformance")
    group.addoption("--axis", metavar="DRIVE[,DRIVE]", help="kinds of drives; default: all")
    group.addoption("--moments", type=int, default=10, help="faults at random moments per drive")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the table."""
    table: dict[str, dict[str, str]] = {}
    for report in terminalreporter.getreports("passed") + terminalreporter.getreports("failed"):
        for name, value in report.user_properties:
            if name == ROW:
                axis, rule, verdict = value
                is_failure = report.failed or table.get(rule, {}).get(axis) == "FAILED"
                table.setdefault(rule, {})[axis] = "FAILED" if is_failure else verdict
    axes = list(dict.fromkeys(axis for row in table.values() for axis in row))
    if axes:
        terminalreporter.section("rules by drive")
        for name, row in {"rule": dict(zip(axes, axes, strict=True)), **table}.items():
            cells = (name, *(row.get(axis, "") for axis in axes))
            terminalreporter.write_line("".join(f"{cell:22}" for cell in cells).rstrip())
