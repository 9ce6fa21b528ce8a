"""The package's executables."""

from needle_common.commands.executables import node

console = node("needle_console.ros.console")
