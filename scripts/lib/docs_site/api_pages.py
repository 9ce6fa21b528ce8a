"""Pages of the libraries, generated from the docstrings by autodoc."""

from __future__ import annotations

import ast

from reference.endpoints import SOURCES
from reference.markdown import table

LIBRARIES = (
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
"""Packages for user-written estimators, laws, planners, studies and programs that read bags."""


def api_pages() -> dict[str, str]:
    """Return an index and one page for each package, by file name."""
    rows = []
    found = {}
    for library in LIBRARIES:
        package, _, name = library.partition(".")
        folder = SOURCES / package / package / name
        text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
        rows.append((f"[`{library}`](api/{library}.md)", text.partition("\n\n")[0]))
        modules = [path.stem for path in sorted(folder.glob("*.py")) if path.stem != "__init__"]
        found[f"api/{library}.md"] = "\n\n".join(
            (
                f"# {library}",
                text,
                *(_automodule(library, module) for module in modules),
            )
        )
    index = (
        "# Libraries\n\nLibraries without ROS for your own components, in SI units.\n\n"
        + table(("package", "purpose"), rows)
    )
    return {"api.md": index, **found}


def _automodule(library: str, module: str) -> str:
    lines = (f".. automodule:: {library}.{module}", "   :members:")
    return "\n".join((f"## {module}", "", "```{eval-rst}", *lines, "```"))
