"""All pages of the reference."""

from __future__ import annotations

from reference.command_pages import commands_page
from reference.diagnostic_pages import diagnostics_page
from reference.markdown import NODES
from reference.node_pages import node_page, nodes_index, services_page, topics_page
from reference.rig_nodes import rig_nodes


def pages() -> dict[str, str]:
    """Return every page by file name."""
    nodes = rig_nodes()
    return {
        "nodes.md": nodes_index(nodes),
        "topics.md": topics_page(nodes),
        "services.md": services_page(nodes),
        "diagnostics.md": diagnostics_page(nodes),
        "commands.md": commands_page(nodes),
        **{f"{NODES}{node.name}.md": node_page(node) for node in nodes},
    }
