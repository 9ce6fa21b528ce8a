"""The documentation site builds without warnings and loads nothing from the network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from code_lines import ROOT
from docs_site.navigation import listed, navigation, parts

# A link, script or image that a page loads from another host.
ELSEWHERE = re.compile(r'<(?:link|script|img)\b[^>]*\b(?:href|src)="((?:https?:)?//[^"]*)"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx", reason="scripts/docs installs it")
    out = tmp_path_factory.mktemp("docs") / "site"
    done = subprocess.run(
        [sys.executable, "-m", "docs_site.build", "--out", out],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(
                [
                    *map(str, (ROOT / "scripts/lib", ROOT / "tests", ROOT / "tests/shared")),
                    os.environ["PYTHONPATH"],
                ]
            ),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out


def test_nothing_is_loaded_from_other_hosts(site: Path) -> None:
    pages = [path.read_text("utf-8") for path in site.rglob("*.html")]
    assert len(pages) > 60
    assert [link for page in pages for link in ELSEWHERE.findall(page)] == []
    style = "".join(path.read_text("utf-8") for path in site.rglob("*.css"))
    assert "url(http" not in style
    assert "@import" not in style


def test_names_of_the_code_lead_to_their_descriptions(site: Path) -> None:
    name = "needle_controller.model.kinematics.angles_from_rotation"
    link = f'href="reference/api/needle_controller.model.html#{name}"'
    assert link in (site / "docs" / "equations.html").read_text("utf-8")
    described = (site / "docs/reference/api/needle_controller.model.html").read_text("utf-8")
    assert f'id="{name}"' in described


def test_sections_of_the_overview_are_those_of_the_navigation() -> None:
    overview = """\
# All

[Not in a section](no.md)

## One

- [A](a.md), and [a place in it](a.md#place), and [elsewhere](https://x.org/y.md)
- [B](../b/README.md); [A again](a.md)

## Two

- [C](deep/c.md)
"""
    text = navigation(overview)
    one, two = text.partition(":caption: Two")[::2]
    assert ":caption: One" in one
    assert one.count("</docs/a>") == one.count("A </docs/a>") == 1
    assert "B </b/README>" in one
    assert "C </docs/deep/c>" in two
    assert "</docs/no>" not in text


def test_parts_of_a_generated_page_stand_below_it() -> None:
    assert parts(["x.md", "x/a.md", "y.md"]) == {"x.md": ["x/a.md"], "y.md": []}
    assert listed({"x.md": "X"}) == "- [X](reference/x.md)"
