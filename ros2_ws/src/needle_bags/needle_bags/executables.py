"""The package's executables."""

from needle_core.commands.executables import command, node

live_view = node("needle_bags.ros.live_view")
openigtlink = node("needle_bags.ros.openigtlink")
peer_topics = node("needle_bags.ros.peer_topics")
player = node("needle_bags.ros.player")
recorder = node("needle_bags.ros.recorder")
recover = command("needle_bags.recovery.recover")
report = command("needle_bags.report.report")
rerun = command("needle_bags.ros.rerun")
