"""Page of command lines: `--help` of every command and script."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from unittest import mock

from code_lines import ROOT
from reference.markdown import block, node_link
from reference.rig_nodes import RigNode, executables

SCRIPTS = ROOT / "scripts"
_WIDTH = "100"


def scripts() -> list[str]:
    """Return the names of the executable scripts."""
    return sorted(
        path.name for path in SCRIPTS.iterdir() if path.is_file() and os.access(path, os.X_OK)
    )


def help_of_module(module: str, name: str) -> str:
    """Return the `--help` text of a command, run in this process."""
    output = io.StringIO()
    with (
        contextlib.redirect_stdout(output),
        contextlib.suppress(SystemExit),
        mock.patch.object(sys, "argv", [name, "--help"]),
        mock.patch.dict(os.environ, COLUMNS=_WIDTH),
    ):
        importlib.import_module(module).main()
    return output.getvalue()


def help_of_script(name: str) -> str:
    """Return the `--help` text of a script; a Python script runs in this process."""
    text = (SCRIPTS / name).read_text("utf-8")
    module = re.search(r'^run python -m (\S+) "\$@"$', text, re.MULTILINE)
    if module:
        return help_of_module(module[1], name)
    file = re.search(r'^run python "\$here/lib/(\S+)\.py" "\$@"$', text, re.MULTILINE)
    if file:
        folder = str((SCRIPTS / "lib" / file[1]).parent)
        with mock.patch.object(sys, "path", [folder, *sys.path]):
            return help_of_module(file[1].rpartition("/")[2], name)
    done = subprocess.run(
        [SCRIPTS / name, "--help"], capture_output=True, text=True, check=True, timeout=60
    )
    return done.stdout


def commands_page(nodes: Sequence[RigNode]) -> str:
    """Return the page of command lines."""
    links = ", ".join(node_link(node.name) for node in nodes)
    page = [
        "# Command lines\n\nExit codes are the same for all "
        f"([architecture](../architecture.md#exit-codes)). Nodes: {links}.\n\n## Scripts\n\n"
    ]
    for name in scripts():
        page.append(f"### scripts/{name}\n\n{block(help_of_script(name))}")
    page.append("## Executables\n\n")
    for package, name, module in executables("command"):
        page.append(f"### {name}\n\n    ros2 run {package} {name}\n\n")
        page.append(block(help_of_module(module, name)))
    # The player has its own options in addition to its parameters.
    page.append(f"### player\n\n{block(help_of_module('needle_bags.ros.player', 'player'))}")
    return "".join(page)
