"""The package's executables."""

from needle_core.commands.executables import command, node

live_view = node("needle_analysis.ros.live_view")
openigtlink = node("needle_analysis.ros.openigtlink")
report = command("needle_analysis.report.report")
rerun = command("needle_analysis.ros.rerun")
