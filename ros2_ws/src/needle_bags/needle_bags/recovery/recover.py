"""`recover`: makes a bag whole that a crash, a kill or a full disk left behind."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from needle_bags.recovery.bag_recovery import BagRecovery, recover_bag
from needle_common.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_common.commands.options import CommandParser, output_file

_DESCRIPTION = """
Makes a bag whole again whose recording was cut off (by a crash, kill -9, a power cut or a full
disk) or whose files were damaged. What can be read is written into new files, and what could not be
read is named. What was there stays as FILE.damaged until you delete it, so there must be room for a
copy. A bag that is whole is left as it is.
"""
_EXAMPLES = """
examples:
  ros2 run needle_bags recover bags/my_run
  ros2 run needle_bags recover bags/my_run --json recovery.json

exit codes: 0 the bag is whole now (also if something was lost: it is named); 2 there is no bag, it
is still being recorded, or the disk refuses the changes; 130 interrupted (run it again)
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = CommandParser("recover", _DESCRIPTION, _EXAMPLES)
    parser.add_argument("bag", type=Path, metavar="BAG", help="the bag's directory")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write what was done as flat JSON"
    )

    def command() -> int:
        options = parser.parse_args(arguments)
        file = output_file("--json", options.json)
        recovery = recover_bag(options.bag)
        for line in _lines(options.bag, recovery):
            print(line)
        if file is not None:
            write_json(file, _flat(recovery))
        return EXIT_DONE

    return run_command(command)


def _lines(bag: Path, recovery: BagRecovery) -> list[str]:
    holds = f"{recovery.messages} messages of {recovery.topics} topics"
    if recovery.was_whole:
        return [f"{bag} is whole: {holds}; nothing to do"]
    lines = [f"recovered {bag}: {holds}"]
    lines += [f"  lost: {loss}" for loss in recovery.losses.lines()]
    if not recovery.losses.lines():
        lines.append("  lost: nothing that had been written")
    if recovery.kept:
        lines.append(f"  what was there is kept as {', '.join(recovery.kept)}: delete it when done")
    return lines


def _flat(recovery: BagRecovery) -> dict[str, JsonValue]:
    return {
        "was_whole": recovery.was_whole,
        "messages": recovery.messages,
        "topics": recovery.topics,
        "files": len(recovery.files),
        "lost_messages": sum(recovery.losses.messages.values()),
        "lost_messages_exact": recovery.losses.is_exact,
        "lost_bytes": recovery.bytes_lost,
        "lost_files": len(recovery.losses.missing),
    }


if __name__ == "__main__":
    sys.exit(main())
