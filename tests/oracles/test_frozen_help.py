"""`--help` of every command and script is the frozen text in `help/`.

After an intended change, renew the texts and review them with `git diff`:

    PYTHONPATH=scripts/lib:tests:tests/shared python tests/oracles/test_frozen_help.py
"""

from __future__ import annotations

from pathlib import Path

from reference.command_pages import help_of_module, help_of_script, scripts
from reference.rig_nodes import executables

HELP = Path(__file__).resolve().parent / "help"


def help_texts() -> dict[str, str]:
    texts = {name: help_of_module(module, name) for _, name, module in executables("command")}
    texts["player"] = help_of_module("needle_bags.ros.player", "player")
    return texts | {f"scripts_{name}": help_of_script(name) for name in scripts()}


def test_every_help_is_the_frozen_text() -> None:
    assert help_texts() == {file.stem: file.read_text("utf-8") for file in HELP.glob("*.txt")}


if __name__ == "__main__":
    for name, text in help_texts().items():
        (HELP / f"{name}.txt").write_text(text, "utf-8")
