"""Settings of Sphinx; `docs_site.build` runs it."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx

project = "Needle steering"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "README"
# Blocks without a language are commands and plain-text tables.
highlight_language = "none"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_ivar = True
# In a docstring, `x` is a name or a value.
default_role = "py:obj"

# List only pages in the navigation, because every page would repeat the functions.
toc_object_entries = False

html_theme = "furo"
html_title = project
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
_BEFORE_NAPOLEON = 400
_FULL_NAME = re.compile(r"needle_\w+(\.\w+)+")


def _escape(app: Sphinx, what: str, *described: Any) -> None:
    """Escape absolute values `|x|`, which reStructuredText would treat as substitutions."""
    lines: list[str] = described[-1]
    lines[:] = [line.replace("|", "\\|") for line in lines]
    if what in ("attribute", "data"):
        # Napoleon reads the text before the first colon as a type.
        lines[:1] = [f": {line}" for line in lines[:1]]


def _link_names(app: Sphinx, page: nodes.document) -> None:
    """Link full names in a text to their descriptions on the library pages."""
    for literal in list(page.findall(nodes.literal)):
        name = literal.astext()
        if _FULL_NAME.fullmatch(name) and not isinstance(literal.parent, nodes.reference):
            link = addnodes.pending_xref(
                "", refdomain="py", reftype="obj", reftarget=name, refdoc=app.env.docname
            )
            literal.replace_self(link)
            link += literal


def _inline_math(writer: Any, node: nodes.math) -> None:
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _displayed_math(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register the hooks, and a renderer that writes equations as MathML."""
    app.connect("autodoc-process-docstring", _escape, priority=_BEFORE_NAPOLEON)
    app.connect("doctree-read", _link_names)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_displayed_math, None))
