"""Copy of the checkout's pages in the source folder of Sphinx, under the same paths."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from code_lines import ROOT
from docs_site.navigation import FRONT, GENERATED, OVERVIEW, listed, navigation, parts, toctree
from reference.markdown import block

PAGES = ("*.md", "bags/*.md", "docs/**/*.md", "ros2_ws/src/*/README.md")
REFERENCE = "docs/reference"
"""Folder of the generated pages."""
LISTING = "files.md"
"""Page with all files of a folder, to which links to the folder lead."""
_LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")
_NOT_LISTED = ("build", "__pycache__")


def pages() -> list[Path]:
    """Return the paths of the checkout's pages, relative to it."""
    return sorted({path.relative_to(ROOT) for form in PAGES for path in ROOT.glob(form)})


def write_tree(folder: Path, generated: dict[str, str]) -> None:
    """Write the input of Sphinx into a folder.

    Parameters
    ----------
    folder : Path
        An empty folder.
    generated : dict of str to str
        Pages of the reference by their path below `REFERENCE`; `x/y.md` is a part of `x.md`.
    """
    for page in pages():
        text = (ROOT / page).read_text("utf-8")
        for target in sorted(set(_LINK.findall(text))):
            text = _copy_target(page, target, text, folder)
        _write(folder / page, text)
    for name, below in parts(generated).items():
        tree = toctree([f"/{REFERENCE}/{part}" for part in below])
        _write(folder / REFERENCE / name, generated[name] + tree)
        for part in below:
            _write(folder / REFERENCE / part, generated[part])
    titles = {name: generated[name].partition("\n")[0].lstrip("# ") for name in parts(generated)}
    overview = (folder / OVERVIEW).read_text("utf-8").replace(GENERATED, listed(titles))
    _write(folder / OVERVIEW, overview)
    _write(folder / FRONT, (folder / FRONT).read_text("utf-8") + navigation(overview))


def _copy_target(page: Path, target: str, text: str, folder: Path) -> str:
    """Copy the target of a link; return the text, with links to a folder replaced by its page."""
    there = (ROOT / page.parent / target).resolve()
    if there.suffix == ".md" or not there.is_relative_to(ROOT):
        return text
    copy = folder / there.relative_to(ROOT)
    if there.is_file():
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(there, copy)
    elif there.is_dir():
        _write(copy / LISTING, _listing(there))
        return text.replace(f"]({target})", f"]({target.rstrip('/')}/{LISTING})")
    return text


def _listing(folder: Path) -> str:
    """Return a page with all files of a folder."""
    page = [f"---\norphan: true\n---\n\n# {folder.relative_to(ROOT)}\n\n"]
    for file in _files(folder):
        language = {".py": "python", ".toml": "toml", ".yaml": "yaml"}.get(file.suffix, "text")
        text = block(file.read_text("utf-8"), language)
        page.append(f"## {file.relative_to(folder)}\n\n{text}")
    return "".join(page)


def _files(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        names = path.relative_to(folder).parts
        if path.is_file() and not any(
            name in _NOT_LISTED or name.endswith(".egg-info") for name in names
        ):
            yield path


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
