"""Each pain in docs/known_pains.md names a test that there is."""

from __future__ import annotations

import re

from campaign.typed_pages import ROOT


def test_every_pain_is_answered_by_a_test_that_there_is() -> None:
    rows = re.findall(
        r"^\| .* \| .* \| `(test_\w+)` \|$", read("docs/known_pains.md"), re.MULTILINE
    )
    folders = [ROOT / "tests", *ROOT.glob("ros2_ws/src/*/test")]
    there = {
        name
        for folder in folders
        for path in folder.rglob("test_*.py")
        for name in re.findall(
            r"^\s*(?:async )?def (test_\w+)", path.read_text("utf-8"), re.MULTILINE
        )
    }
    assert len(rows) == read("docs/known_pains.md").count("`test_")
    assert [name for name in rows if name not in there] == []


def read(name: str) -> str:
    return (ROOT / name).read_text("utf-8")
