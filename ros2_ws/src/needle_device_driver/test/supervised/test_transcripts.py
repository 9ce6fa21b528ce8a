"""What goes over the wire, byte by byte: `transcripts/*.txt`, each line a frame as candump has it.

The files were checked by hand against CiA 301 and CiA 402; a change of a byte is a change of what
drives are told. Lines that begin with # explain.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from .drive_bench import DriveBench

FOLDER = Path(__file__).resolve().parent / "transcripts"
HEARTBEAT = 0x77F


def set_up(bench: DriveBench) -> int:
    bench.run(bench.supervisor.configure(bench.clock()))
    return 0


def home(bench: DriveBench) -> int:
    bench.configured()
    start = len(bench.bus.sent)
    bench.supervisor.confirm_needle_out(True)
    bench.run(bench.supervisor.home(bench.clock()))
    bench.cycle(16)
    return start


def move(bench: DriveBench) -> int:
    bench.homed()
    start = len(bench.bus.sent)
    bench.supervisor.enable(True, bench.clock())
    bench.cycle(4)
    bench.hold(False)
    bench.hold()
    bench.step(0.0004, -0.1, 0.08)
    bench.cycle(6, holding=True)
    assert bench.outcomes == ["succeeded"]
    return start


def quick_stop(bench: DriveBench) -> int:
    bench.moving()
    start = len(bench.bus.sent)
    bench.cycle(1, holding=True)
    bench.hold(False)
    bench.cycle(2)
    return start


def fault_and_reset(bench: DriveBench) -> int:
    bench.moving()
    start = len(bench.bus.sent)
    bench.rotation.fail(0x8611)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    bench.hold(False)
    bench.cycle(5)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    bench.cycle(3)
    return start


@pytest.mark.parametrize("scene", [set_up, home, move, quick_stop, fault_and_reset])
def test_the_bytes_are_those_of_the_transcript(drive_bench: DriveBench, scene: Any) -> None:
    start = scene(drive_bench)
    sent = [
        f"{cob_id:03X}#{data.hex().upper()}"
        for cob_id, data in drive_bench.bus.sent[start:]
        # Its times are test_drive_rules' concern.
        if cob_id != HEARTBEAT
    ]
    lines = (FOLDER / f"{scene.__name__}.txt").read_text("utf-8").splitlines()
    assert sent == [line.split()[0] for line in lines if line and not line.startswith("#")]
