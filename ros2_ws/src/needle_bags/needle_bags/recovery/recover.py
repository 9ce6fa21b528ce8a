"""`recover`: completes the bag of a recording that a crash, a kill or a full disk ended."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from needle_bags.recovery.bag_recovery import BagRecovery, recover_bag
from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser, output_file

_DESCRIPTION = """
Complete a bag that is damaged, or whose recording was interrupted (by a crash, kill -9, a power
failure or a full disk). Everything before the first damage is kept, also in a bag of several files;
if metadata.yaml has the duration, the lost seconds are printed.

The files of the bag are those of metadata.yaml, or else <stem>_<n>.mcap of one stem; other files in
the directory are listed and not changed. The previous files remain as FILE.damaged until you delete
them, so the disk needs space for a copy. A complete bag is not changed. A single .mcap file is
completed without the other files of its directory.
"""
_EXAMPLES = """
examples:
  ros2 run needle_bags recover bags/my_run
  ros2 run needle_bags recover bags/my_run --json recovery.json
  ros2 run needle_bags recover downloads/monday.mcap

exit codes: 0 the bag is complete, perhaps with lost data; 2 there is no bag, it is still being
recorded, nothing precedes the damage, or it cannot be written; 130 interrupted (run it again)
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = CommandParser("recover", _DESCRIPTION, _EXAMPLES)
    parser.add_argument("bag", type=Path, metavar="BAG", help="directory of the bag, or a file")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write a summary as flat JSON"
    )

    def command() -> int:
        options = parser.parse_args(arguments)
        file = output_file("--json", options.json)
        recovery = recover_bag(options.bag)
        for line in _lines(options.bag, recovery):
            print(line)
        write_json(file, _flat(recovery))
        return EXIT_DONE

    return run_command(command)


def _lines(bag: Path, recovery: BagRecovery) -> list[str]:
    holds = f"{recovery.messages} messages of {len(recovery.bag.topics)} topics"
    left_out = [f"  left out: {line}" for line in recovery.left_out]
    if recovery.was_whole:
        return [f"{bag} is complete: {holds}; nothing to do", *left_out]
    lines = [f"recovered {bag}: {holds}"]
    lines.append(f"  lost: {recovery.lost or 'nothing that was written'}")
    lines += left_out
    if recovery.kept:
        lines.append(f"  previous files, delete them when done: {', '.join(recovery.kept)}")
    return lines


def _flat(recovery: BagRecovery) -> dict[str, JsonValue]:
    return {
        "was_whole": recovery.was_whole,
        "messages": recovery.messages,
        "topics": len(recovery.bag.topics),
        "lost": recovery.lost,
        "lost_s": recovery.seconds_lost,
        "files_left_out": len(recovery.left_out),
    }


if __name__ == "__main__":
    sys.exit(main())
