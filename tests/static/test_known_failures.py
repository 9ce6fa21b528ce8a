"""Each known failure in docs/troubleshooting.md names an existing test."""

from __future__ import annotations

import re

from campaign.typed_pages import ROOT


def test_every_known_failure_names_an_existing_test() -> None:
    page = (ROOT / "docs/troubleshooting.md").read_text("utf-8")
    rows = re.findall(r"^\| .* \| `(test_\w+)` \|$", page, re.MULTILINE)
    folders = [ROOT / "tests", *ROOT.glob("ros2_ws/src/*/test")]
    there = {
        name
        for folder in folders
        for path in folder.rglob("test_*.py")
        for name in re.findall(
            r"^\s*(?:async )?def (test_\w+)", path.read_text("utf-8"), re.MULTILINE
        )
    }
    assert len(rows) == page.count("`test_") > 0
    assert [name for name in rows if name not in there] == []
