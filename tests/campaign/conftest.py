"""Campaign tests run only on request: `scripts/test -m campaign` or `scripts/verify`."""

from __future__ import annotations

from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).parent


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Ignore the campaign unless the command line names it."""
    return None if config.getoption("markexpr") == "campaign" else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder."""
    for item in items:
        if item.path.is_relative_to(CAMPAIGN):
            item.add_marker("campaign")
