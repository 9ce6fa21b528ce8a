"""Frames on the bus, compared byte by byte with `transcripts/*.txt`, in the format of candump.

The files were checked by hand against CiA 301 and CiA 402. Lines that begin with # are comments.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from .drive_bench import DriveBench

FOLDER = Path(__file__).resolve().parent / "transcripts"


def set_up(bench: DriveBench) -> None:
    bench.configure()


def home(bench: DriveBench) -> None:
    bench.configured()
    bench.bus.sent.clear()
    bench.home()
    bench.wait(16)


def move(bench: DriveBench) -> None:
    bench.homed()
    bench.bus.sent.clear()
    bench.enable()
    bench.wait(4)
    bench.press()
    bench.step(0.0004, -0.1, 0.08)
    bench.go(6)


def quick_stop(bench: DriveBench) -> None:
    bench.moving()
    bench.bus.sent.clear()
    bench.go()
    bench.hold(False)
    bench.wait(2)


def fault_and_reset(bench: DriveBench) -> None:
    bench.moving()
    bench.bus.sent.clear()
    bench.after(lambda: bench.rotation.fail(0x8611))
    bench.hold(False)
    bench.wait(5)
    assert bench.reset().success
    bench.wait(3)


@pytest.mark.parametrize("scene", [set_up, home, move, quick_stop, fault_and_reset])
def test_frames_match_the_transcript(scene: Callable[[DriveBench], None]) -> None:
    bench = DriveBench()
    scene(bench)
    # test_bus_rules checks the heartbeats.
    sent = [f"{cob:03X}#{data.hex().upper()}" for cob, data in bench.bus.sent if cob != 0x77F]
    lines = (FOLDER / f"{scene.__name__}.txt").read_text("utf-8").splitlines()
    assert sent == [line.split()[0] for line in lines if line and not line.startswith("#")]
