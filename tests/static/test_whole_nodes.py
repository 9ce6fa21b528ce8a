"""Every node is destroyed if its construction fails."""

from __future__ import annotations

import ast

from code_lines import ROOT

RCLPY = {"Node", "LifecycleNode"}


def test_no_node_is_rclpys_own() -> None:
    found = []
    for path in sorted((ROOT / "ros2_ws" / "src").glob("*/*/ros/*.py")):
        if "test" in path.parts or path.name == "base_node.py":
            continue
        for part in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(part, ast.ClassDef):
                bases = {base.id for base in part.bases if isinstance(base, ast.Name)}
                if bases & RCLPY:
                    found.append(f"{path.relative_to(ROOT)}: {part.name}")
    assert found == []
