"""The documents' site: no warning, no dead link, nothing loaded from the network."""

from __future__ import annotations

import os
import subprocess
import sys
import urllib.parse
from html.parser import HTMLParser
from pathlib import Path

import pytest

from code_lines import ROOT
from docs_site.navigation import listed, navigation, parts

# Elements that a page loads by itself, with their attribute.
LOADS = {"link": "href", "script": "src", "img": "src"}


class Page(HTMLParser):
    """Links, loaded files and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = {""}
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag in LOADS and LOADS[tag] in given and given.get("rel") not in ("next", "prev"):
            self.loaded.append(given[LOADS[tag]])
        elif tag == "a" and "href" in given:
            self.links.append(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx", reason="scripts/docs installs it")
    out = tmp_path_factory.mktemp("docs") / "site"
    done = subprocess.run(
        [sys.executable, "-m", "docs_site.build", "--out", out],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(
                [*map(str, (ROOT / "scripts/lib", ROOT / "tests")), os.environ["PYTHONPATH"]]
            ),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob("*.html") if "_static" not in path.parts}


def test_every_link_within_the_site_leads_somewhere(site: Path, pages: dict[Path, Page]) -> None:
    assert len(pages) > 60
    dead = []
    for path, page in pages.items():
        for link in (*page.links, *page.loaded):
            parsed = urllib.parse.urlsplit(link)
            if parsed.scheme in ("http", "https", "mailto"):
                continue
            there = (path.parent / urllib.parse.unquote(parsed.path)).resolve()
            there = there if parsed.path else path
            if not there.is_file() or (
                there in pages and parsed.fragment and parsed.fragment not in pages[there].anchors
            ):
                dead.append(f"{path.relative_to(site)}: {link}")
    assert dead == []


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    loaded = {link for page in pages.values() for link in page.loaded}
    assert [link for link in loaded if urllib.parse.urlsplit(link).netloc] == []
    style = "".join(path.read_text("utf-8") for path in site.rglob("*.css"))
    assert "url(http" not in style
    assert "@import" not in style


def test_names_of_the_code_lead_to_their_descriptions(site: Path, pages: dict[Path, Page]) -> None:
    links = pages[site / "docs/equations.html"].links
    name = "needle_controller.model.kinematics.angles_from_rotation"
    assert f"reference/api/needle_controller.model.html#{name}" in links


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
