"""Pages of the nodes, with the topics, services, parameters and diagnostics of each."""

from __future__ import annotations

import math
from collections.abc import Sequence

from needle_core.settings.parameter_fields import ParameterSpec, specs
from reference.endpoints import CALLS, PUBLISHES, SERVES, SUBSCRIBES
from reference.markdown import block, code, node_link, table
from reference.rig_nodes import RigNode

OPEN_TOPICS = {
    "recorder": "`recorder` subscribes to every topic that it records.\n\n",
    "player": "`player` publishes the topics of its bag; commands, holds and targets only below "
    "`/replay`.\n\n",
}
"""Notes on topics that depend on the graph or a bag, by node."""
OPEN_SERVICES = {"recorder": "`recorder` asks every node for its parameters.\n\n"}
"""Notes on services that depend on the graph, by node."""
_EVERY_NODE = """\
Every node also publishes `/diagnostics` and `/rosout`, and has ROS's own services and
`/parameter_events` for parameters.
"""


def node_page(node: RigNode) -> str:
    """Return the page of a node."""
    ends = node.endpoints(PUBLISHES, SUBSCRIBES)
    calls = node.endpoints(SERVES, CALLS)
    topics = [
        (end.role, code(end.name), code(end.type_name), end.qos, when)
        for end, when in sorted(ends, key=lambda each: (each[0].role != PUBLISHES, each[0].name))
    ]
    services = [
        ("serves" if end.role == SERVES else "calls", code(end.name), code(end.type_name), when)
        for end, when in sorted(calls, key=lambda each: (each[0].role != SERVES, each[0].name))
    ]
    note = OPEN_TOPICS.get(node.name, "") + OPEN_SERVICES.get(node.name, "")
    parts = [(code(part), ", ".join(map(code, keys))) for part, keys in node.parts.items()]
    return "".join(
        (
            f"# {node.name}\n\n",
            f"    ros2 run {node.package} {node.name}\n\n",
            block(node.help) if node.help else "",
            "## Topics\n\n" if topics or note else "",
            table(("", "topic", "type", "quality of service", "when"), topics),
            note,
            "## Services\n\n" if services else "",
            table(("", "service", "type", "when"), services),
            "## Parameters\n\n",
            parameter_table(node.parameters),
            "## Diagnostics\n\n" if parts else "",
            table(("part", "keys of its values"), parts),
        )
    )


def parameter_table(parameters: type) -> str:
    """Return the table of a dataclass's parameters."""
    rows = []
    for name, spec, default in specs(parameters):
        shown = list(default) if isinstance(default, tuple) else default
        text = repr(shown).replace("'", '"') if isinstance(shown, (str, list)) else repr(shown)
        rows.append(
            (
                code(name),
                code(text.lower() if isinstance(shown, bool) else text),
                "" if spec.unit == "-" else spec.unit,
                _allowed(spec),
                spec.description + ("" if spec.read_only else " *May be set at run time.*"),
            )
        )
    return table(("parameter", "default", "unit", "range", "description"), rows)


def _allowed(spec: ParameterSpec) -> str:
    if spec.choices:
        return ", ".join(code(choice) if choice else "empty" for choice in spec.choices)
    lower, upper = f"{spec.lower:g}", f"{spec.upper:g}"
    if math.isfinite(spec.lower) and math.isfinite(spec.upper):
        return f"{lower} to {upper}"
    if math.isfinite(spec.lower):
        return f"from {lower}"
    return f"to {upper}" if math.isfinite(spec.upper) else ""


def nodes_index(nodes: Sequence[RigNode]) -> str:
    """Return the index of the node pages."""
    rows = [(node_link(node.name), code(node.package), _first_sentence(node)) for node in nodes]
    return f"# Nodes\n\n{_EVERY_NODE}\n{table(('node', 'package', 'purpose'), rows)}"


def _first_sentence(node: RigNode) -> str:
    text = node.help or (node.module.__doc__ or "")
    first = text.strip().partition("\n\n")[0]
    return " ".join(first.removeprefix(f"{node.name}: ").split()).partition(". ")[0].rstrip(".")


def topics_page(nodes: Sequence[RigNode]) -> str:
    """Return the page of topics, with publishers and subscribers."""
    return (
        "# Topics\n\nNames are relative unless they begin with `/`, so a namespace moves the whole "
        "rig. The number is the queue depth; latched messages also reach later subscribers."
        "\n\n"
        + _both_ends(nodes, PUBLISHES, SUBSCRIBES, ("topic", "type", "publishers", "subscribers"))
        + "".join(OPEN_TOPICS.values())
        + _EVERY_NODE
    )


def services_page(nodes: Sequence[RigNode]) -> str:
    """Return the page of services, with servers and clients."""
    return (
        "# Services\n\n"
        + _both_ends(nodes, SERVES, CALLS, ("service", "type", "servers", "clients"))
        + "".join(OPEN_SERVICES.values())
        + _EVERY_NODE
    )


def _both_ends(nodes: Sequence[RigNode], near: str, far: str, head: Sequence[str]) -> str:
    """Return a table of topics or services, with the nodes that have either role."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for node in nodes:
        for end, when in node.endpoints(near, far):
            sides = found.setdefault((end.name, end.type_name), {near: [], far: []})
            sides[end.role].append(_at_end(node, end.qos, when))
    rows = [
        (code(name), code(kind), "<br>".join(ends[near]), "<br>".join(ends[far]))
        for (name, kind), ends in sorted(found.items(), key=lambda each: each[0][0].lstrip("/"))
    ]
    return table(head, rows)


def _at_end(node: RigNode, qos: str, when: str) -> str:
    more = "; ".join(text for text in (qos, when) if text)
    return f"{node_link(node.name)}{f' ({more})' if more else ''}"
