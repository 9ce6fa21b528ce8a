"""Contract of import-linter: only subpackages called `ros` may import ROS.

Every other module of the given packages, including future ones, is pure: it imports neither ROS nor
a module of such a subpackage, so that no chain of imports leads to ROS.
"""

from __future__ import annotations

import re
from typing import cast

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output

ROS = re.compile(r"rclpy|rosidl_.*|launch|launch_ros|.*_msgs|.*_interfaces|std_srvs")


def is_in_ros(module: str) -> bool:
    """Return whether a module is in its package's subpackage `ros`."""
    return module.split(".")[1:2] == ["ros"]


def is_ros(module: str) -> bool:
    """Return whether a module belongs to ROS."""
    return ROS.fullmatch(module.partition(".")[0]) is not None


class RosFolderContract(Contract):
    """Contract that pure modules import neither ROS nor a module of a subpackage `ros`."""

    packages = fields.ListField(subfield=fields.StringField())

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Return each import that leads from a pure module to ROS."""
        ours = tuple(str(name) for name in cast("list[str]", self.packages))
        broken = []
        for importer in sorted(graph.modules):
            if not importer.startswith(ours) or is_in_ros(importer):
                continue
            for imported in sorted(graph.find_modules_directly_imported_by(importer)):
                inside = imported.startswith(ours) and is_in_ros(imported)
                if not (inside or is_ros(imported)):
                    continue
                details = graph.get_import_details(importer=importer, imported=imported)
                lines = ", ".join(str(detail["line_number"]) for detail in details)
                broken.append(f"{importer} -> {imported} (line {lines})")
        return ContractCheck(kept=not broken, metadata={"broken": broken})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print the imports that break the contract."""
        output.print_error("Only modules of the folders `ros` may import ROS or each other:")
        output.new_line()
        for line in check.metadata["broken"]:
            output.print_error(f"- {line}")
