"""Project files: files and tests that they name exist, and versions agree."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from code_lines import ROOT
from needle_bringup.simulation.simulate_options import parse

WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
SCRIPT = re.compile(r"(?<![\w./])(?:needle/)?((?:scripts|\.ci)/[\w/.]+)")


def example() -> str:
    """Return the workflow for another repository in docs/tests.md."""
    page = (ROOT / "docs/tests.md").read_text("utf-8")
    return page.partition("```yaml\n")[2].partition("```")[0]


def workflows() -> dict[str, Any]:
    texts = {path.name: path.read_text("utf-8") for path in WORKFLOWS}
    return {name: yaml.safe_load(text) for name, text in {**texts, "tests.md": example()}.items()}


def commands(workflow: dict[str, Any]) -> str:
    jobs = workflow["jobs"].values()
    return "\n".join(step["run"] for job in jobs for step in job["steps"] if "run" in step)


@pytest.mark.parametrize("name", [*(path.name for path in WORKFLOWS), "tests.md"])
def test_a_workflow_runs_existing_files(name: str) -> None:
    text = commands(workflows()[name])
    scripts = set(SCRIPT.findall(text))
    assert scripts
    assert [script for script in scripts if not (ROOT / script).exists()] == []
    for line in text.replace("\\\n", " ").splitlines():
        words = line.split("||")[0].split()
        if words and words[0].endswith("scripts/simulate"):
            parse(words[1:])


def test_executables_and_launch_files_of_workflows_are_there() -> None:
    text = "\n".join(commands(workflow) for workflow in workflows().values())
    source = ROOT / "ros2_ws/src"
    launched = re.findall(r"ros2 launch (\w+) (\S+)", text)
    run = re.findall(r"ros2 run (\w+) (\w+)", text)
    assert launched
    assert run
    assert all((source / package / "launch" / file).is_file() for package, file in launched)
    for package, name in run:
        assert f"\n{name} = " in (source / package / package / "executables.py").read_text("utf-8")


def test_an_image_is_built_from_existing_stages() -> None:
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text("utf-8"))
    build = container["build"]
    file = (ROOT / ".devcontainer" / build["dockerfile"]).resolve()
    assert file == ROOT / "Dockerfile"
    assert f"AS {build['target']}\n" in file.read_text("utf-8")
    for script in SCRIPT.findall(file.read_text("utf-8")):
        assert os.access(ROOT / script, os.X_OK)


def test_an_image_gets_nothing_that_git_ignores() -> None:
    def lines(name: str) -> set[str]:
        text = (ROOT / name).read_text("utf-8")
        return {line.strip("/") for line in text.splitlines() if not line.startswith("#")}

    made = {".venv", "site", "ros2_ws/build", "ros2_ws/install", "ros2_ws/log", "bags/*"}
    assert made <= lines(".dockerignore")
    assert made <= lines(".gitignore")


def test_all_files_have_one_version() -> None:
    versions = {
        manifest.parent.name: ElementTree.parse(manifest).findtext("version")
        for manifest in sorted(ROOT.glob("ros2_ws/src/*/package.xml"))
    }
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    versions["pyproject.toml"] = re.findall(r'^version = "(\S+)"', project, re.MULTILINE)[0]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    versions["CITATION.cff"] = citation["version"]
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    newest = re.findall(r"^## (\S+),", changes, re.MULTILINE)[0]
    assert set(versions.values()) == {newest}, versions


def test_a_citation_has_the_required_fields() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert {"cff-version", "title", "message", "authors"} <= set(citation)
    assert citation["license"] == "Apache-2.0"
    assert Path(ROOT / "LICENSE").is_file()


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
