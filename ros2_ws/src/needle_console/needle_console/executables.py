"""The package's executables."""

from needle_core.commands.executables import node

console = node("needle_console.ros.console")
