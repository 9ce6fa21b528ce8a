"""The package's executables."""

from needle_common.executables import command, node

recorder = node("needle_bringup.recorder_node")
operator = node("needle_bringup.operator_node")
player = node("needle_bringup.player_node")
recover = command("needle_bringup.recover")
report = command("needle_bringup.report")
rerun = command("needle_bringup.rerun_node")
