"""Two cameras, folders or videos as one source of pairs; the rate at which they come."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.sources.stereo_source import (
    LOST_AFTER,
    CameraPair,
    EndOfRecording,
    RateMeter,
    SourceSettings,
    StampedPair,
    StereoSource,
    open_source,
)

SIZES = {"left": (64, 48), "right": (64, 48)}


class Clock:
    """Every look at it is 1 ms later."""

    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        self.now += 1_000_000
        return self.now


class FakeCapture:
    """A camera of which each grab and retrieve is noted."""

    def __init__(self, name: str, log: list[str], good: bool = True, width: int = 64) -> None:
        self.name, self.log, self.good, self.width = name, log, good, width
        self.opened = True

    def isOpened(self) -> bool:
        return self.opened

    def set(self, key: int, value: float) -> bool:
        return True

    def grab(self) -> bool:
        self.log.append(f"grab {self.name}")
        return self.good

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        self.log.append(f"retrieve {self.name}")
        return True, np.full((48, self.width, 3), 7, np.uint8)

    def release(self) -> None:
        self.opened = False


def settings(left: object, right: object, **others: Any) -> SourceSettings:
    values: dict[str, Any] = {"sizes": SIZES, "rate": 100.0, "loop": False} | others
    return SourceSettings(str(left), str(right), **values)


def cameras(log: list[str], **of_right: Any) -> tuple[CameraPair, dict[str, FakeCapture]]:
    captures = {"0": FakeCapture("0", log), "2": FakeCapture("2", log, **of_right)}
    opened: Callable[[str], Any] = captures.__getitem__
    return CameraPair(settings(0, 2), Clock(), opened), captures


def write_pairs(folder: Path, count: int, size: tuple[int, int] = (64, 48)) -> tuple[Path, Path]:
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for i in range(count):
            level = 10 * i + (5 if side == "right" else 0)
            image = np.full(size[::-1], level, np.uint8)
            cv2.imwrite(str(folder / side / f"{i:03d}.png"), image)
    return folder / "left", folder / "right"


def next_of(source: StereoSource) -> StampedPair:
    pair = source.next()
    assert isinstance(pair, StampedPair)
    return pair


def test_both_cameras_are_grabbed_before_either_is_decoded() -> None:
    log: list[str] = []
    source, captures = cameras(log)
    pair = next_of(source)
    assert log == ["grab 0", "grab 2", "retrieve 0", "retrieve 2"]
    assert (pair.left_stamp, pair.right_stamp) == (1_000_000, 2_000_000)
    assert pair.left.shape == (48, 64)
    assert pair.left.dtype == np.uint8
    source.close()
    assert not any(capture.opened for capture in captures.values())


def test_a_camera_that_gives_nothing_is_gone_after_a_while() -> None:
    source, captures = cameras([])
    captures["2"].good = False
    for _ in range(1, LOST_AFTER):
        assert source.next() is None
    captures["2"].good = True
    next_of(source)
    captures["2"].good = False
    with pytest.raises(UserError, match="20 times in a row"):
        for _ in range(LOST_AFTER):
            source.next()


def test_a_camera_of_another_size_is_refused() -> None:
    source, _ = cameras([], width=80)
    with pytest.raises(UserError, match="right image is 80x48, the calibration is for 64x48"):
        source.next()


def test_folders_come_in_order_and_end(tmp_path: Path) -> None:
    source = open_source(settings(*write_pairs(tmp_path, 3)), Clock())
    for i in range(3):
        pair = next_of(source)
        assert (pair.left[0, 0], pair.right[0, 0]) == (10 * i, 10 * i + 5)
        assert pair.left_stamp == pair.right_stamp
    assert source.next() == EndOfRecording()


def test_a_recording_in_a_loop_begins_again(tmp_path: Path) -> None:
    source = open_source(settings(*write_pairs(tmp_path, 2), loop=True), Clock())
    pairs = [next_of(source) for _ in range(5)]
    assert [pair.left[0, 0] for pair in pairs] == [0, 10, 0, 10, 0]
    assert len({pair.left_stamp for pair in pairs}) == 5


def test_an_unreadable_image_is_dropped_with_its_partner(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path, 3)
    (right / "001.png").write_bytes(b"no image")
    source = open_source(settings(left, right), Clock())
    assert [source.next() is None for _ in range(3)] == [False, True, False]


def test_an_image_of_16_bit_is_none_of_the_camera(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path, 2)
    cv2.imwrite(str(left / "001.png"), np.full((48, 64), 3000, np.uint16))
    source = open_source(settings(left, right), Clock())
    assert [source.next() is None for _ in range(2)] == [False, True]


def write_video(path: Path, count: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()
    return path


def levels_and_missing(source: StereoSource) -> tuple[list[int], str]:
    """Return a grey level of each pair, and what the recording lacked."""
    levels: list[int] = []
    while isinstance(event := source.next(), StampedPair):
        levels.append(int(event.left[24, 32]))
    assert isinstance(event, EndOfRecording)
    return levels, event.missing


def test_videos_serve_as_folders_do(tmp_path: Path) -> None:
    left, right = (write_video(tmp_path / f"{side}.avi", 4) for side in ("left", "right"))
    levels, missing = levels_and_missing(open_source(settings(left, right), Clock()))
    np.testing.assert_allclose(levels, [0, 40, 80, 120], atol=3)
    assert not missing


def test_a_video_that_is_longer_or_cut_off_is_said(tmp_path: Path) -> None:
    left, right = write_video(tmp_path / "left.avi", 6), write_video(tmp_path / "right.avi", 4)
    levels, missing = levels_and_missing(open_source(settings(left, right), Clock()))
    assert (len(levels), missing) == (4, "2 frames without a partner")
    whole = left.read_bytes()
    for path in (left, right):
        path.write_bytes(whole[: whole.index(b"movi") + (len(whole) - whole.index(b"movi")) // 2])
    levels, missing = levels_and_missing(open_source(settings(left, right), Clock()))
    assert len(levels) < 6
    assert f"{6 - len(levels)} of 6 pairs cannot be read" in missing


def test_sources_that_are_wrong(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path / "good", 2)
    other = write_pairs(tmp_path / "large", 2, (80, 60))[0]
    (tmp_path / "empty").mkdir()
    for pair, says in (
        (("", right), "left is empty"),
        ((left, tmp_path / "none"), "does not exist"),
        ((left, tmp_path / "empty"), "no images"),
        ((left, 0), "one is a camera"),
        ((3, 3), "same camera"),
        (("/dev/no_camera", "/dev/no_other"), "/dev/no_camera does not exist"),
        ((left, other), "80x60"),
        ((62, 63), "left camera 62 cannot be opened"),
        (("/dev/null", "/dev/zero"), "left camera /dev/null cannot be opened"),
    ):
        with pytest.raises(UserError, match=says):
            open_source(settings(*pair), Clock())
    (left / "000.png").unlink()
    with pytest.raises(UserError, match=r"right 000\.png"):
        open_source(settings(left, right), Clock())


def test_the_rate_is_that_of_the_last_seconds() -> None:
    meter = RateMeter(window=5.0)
    assert meter.rate(0.0) == 0.0
    for i in range(21):
        meter.tick(0.1 * i)
    assert meter.rate(2.0) == pytest.approx(10.0)
    assert meter.rate(20.0) == 0.0
