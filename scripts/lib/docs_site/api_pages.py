"""Pages of the libraries: what autodoc writes from the docstrings of a room's modules."""

from __future__ import annotations

import ast

from reference.endpoints import SOURCES
from reference.markdown import table

ROOMS = (
    "needle_controller.model",
    "needle_controller.observers",
    "needle_controller.filter",
    "needle_controller.laws",
    "needle_controller.planning",
    "needle_controller.presets",
    "needle_controller.curvature",
    "needle_tracker.optics",
    "needle_bags.reading",
    "needle_bags.run",
    "needle_sim.needle",
    "needle_sim.studies",
)
"""What own estimators, laws, planners, studies and programs that read bags are made of."""


def api_pages() -> dict[str, str]:
    """Return every page by its file's name: an index, and one for each room."""
    rows = []
    found = {}
    for room in ROOMS:
        package, _, name = room.partition(".")
        folder = SOURCES / package / package / name
        said = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
        rows.append((f"[`{room}`](api/{room}.md)", said.partition("\n\n")[0]))
        modules = [path.stem for path in sorted(folder.glob("*.py")) if path.stem != "__init__"]
        found[f"api/{room}.md"] = "\n\n".join(
            (
                f"# {room}",
                said,
                *(_automodule(room, module) for module in modules),
            )
        )
    index = (
        "# Libraries\n\nThe packages' libraries without ROS, for your own programs. SI units "
        "throughout.\n\n" + table(("room", "what it is"), rows)
    )
    return {"api.md": index, **found}


def _automodule(room: str, module: str) -> str:
    lines = (f".. automodule:: {room}.{module}", "   :members:")
    return "\n".join((f"## {module}", "", "```{eval-rst}", *lines, "```"))
