"""Components of users: found by module and name, and what is none is named."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from needle_bringup.simulation.own_component import own_component
from needle_bringup.simulation.simulate_options import parse
from needle_core.errors import UserError

PROBE = """
from needle_core.component import Component

class Probe(Component):
    name = "probe"

class Needy(Component):
    def __init__(self, wanted):
        pass

class Other:
    pass
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a module in the current folder."""
    name = "probe_of_a_user"
    monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / f"{name}.py").write_text(PROBE)
    monkeypatch.chdir(tmp_path)
    return name


def test_it_is_found_in_the_current_folder(module: str) -> None:
    assert own_component(f"{module}:Probe").name == "probe"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Missing", "has no attribute 'Missing'"),
        ("Needy", "missing 1 required positional argument: 'wanted'"),
        ("Other", "makes a Other, no Component"),
    ],
)
def test_what_is_no_component_is_named(module: str, name: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        own_component(f"{module}:{name}")


def test_a_module_that_is_not_there_is_named() -> None:
    with pytest.raises(UserError, match="--component no_such_module:X: No module named"):
        own_component("no_such_module:X")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--component", "probe"], "'probe' is not MODULE:NAME"),
        (["--component", "a:B", "--graph"], "does not go with --graph"),
    ],
)
def test_where_it_cannot_be_it_is_refused(words: list[str], error: str) -> None:
    with pytest.raises(UserError, match=error):
        parse(words)
