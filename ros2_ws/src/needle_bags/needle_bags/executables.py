"""The package's executables."""

from needle_core.commands.executables import command, node

recorder = node("needle_bags.ros.recorder")
player = node("needle_bags.ros.player")
recover = command("needle_bags.recovery.recover")
