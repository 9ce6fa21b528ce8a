"""The package's executables."""

from needle_common.commands.executables import command

report = command("needle_analysis.report.report")
rerun = command("needle_analysis.ros.rerun")
