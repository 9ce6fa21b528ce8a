"""Two cameras, folders or videos as one source of pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.sources.stereo_source import (
    LOST_AFTER,
    EndOfRecording,
    Source,
    StampedPair,
    camera_pairs,
    open_source,
)

SIZES = {"left": (64, 48), "right": (64, 48)}


class Clock:
    """Clock that advances by 1 ms with every reading."""

    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        self.now += 1_000_000
        return self.now


class FakeCapture:
    """Camera that records each grab and retrieve."""

    def __init__(self, name: str, log: list[str], width: int) -> None:
        self.name, self.log, self.width = name, log, width
        self.good = self.opened = True

    def grab(self) -> bool:
        self.log.append(f"grab {self.name}")
        return self.good

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        self.log.append(f"retrieve {self.name}")
        return True, np.full((48, self.width, 3), 7, np.uint8)

    def release(self) -> None:
        self.opened = False


def opened(left: object, right: object, *, loop: bool = False) -> Source:
    return open_source((str(left), str(right)), SIZES, 100.0, Clock(), loop=loop)


def cameras(log: list[str], width: int = 64) -> tuple[Source, list[Any]]:
    captures: list[Any] = [FakeCapture("0", log, 64), FakeCapture("2", log, width)]
    return camera_pairs(captures, SIZES, Clock()), captures


def write_pairs(folder: Path, count: int, size: tuple[int, int] = (64, 48)) -> tuple[Path, Path]:
    for number, side in enumerate(SIZES):
        (folder / side).mkdir(parents=True)
        for i in range(count):
            image = np.full(size[::-1], 10 * i + 5 * number, np.uint8)
            cv2.imwrite(str(folder / side / f"{i:03d}.png"), image)
    return folder / "left", folder / "right"


def levels_of(source: Source, most: int = 99) -> tuple[list[int], str]:
    """Return the grey level of each left image, 0 if unreadable, and the reason of the end."""
    levels: list[int] = []
    while len(levels) < most and not isinstance(event := next(source), EndOfRecording):
        levels.append(int(event.left[24, 32]) if event else -1)
    return levels, event.missing if isinstance(event, EndOfRecording) else "no end"


def test_both_cameras_are_grabbed_before_either_is_decoded() -> None:
    log: list[str] = []
    source, captures = cameras(log)
    pair = next(source)
    assert isinstance(pair, StampedPair)
    assert log == ["grab 0", "grab 2", "retrieve 0", "retrieve 2"]
    assert (pair.left_stamp, pair.right_stamp) == (1_000_000, 2_000_000)
    assert pair.left.shape == (48, 64)
    source.close()
    assert not any(capture.opened for capture in captures)


def test_a_failing_camera_is_lost_after_some_reads() -> None:
    source, captures = cameras([])
    captures[1].good = False
    for _ in range(1, LOST_AFTER):
        assert next(source) is None
    captures[1].good = True
    assert next(source) is not None
    captures[1].good = False
    with pytest.raises(UserError, match="20 times in a row"):
        for _ in range(LOST_AFTER):
            next(source)
    with pytest.raises(UserError, match="right image is 80x48, the calibration is for 64x48"):
        next(cameras([], 80)[0])


def test_folders_are_read_in_order_and_end_or_restart(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path, 3)
    pair = next(opened(left, right))
    assert isinstance(pair, StampedPair)
    assert (pair.left[0, 0], pair.right[0, 0]) == (0, 5)
    assert pair.left_stamp == pair.right_stamp
    assert levels_of(opened(left, right)) == ([0, 10, 20], "")
    source = opened(left, right, loop=True)
    assert levels_of(source, 4) == ([0, 10, 20, 0], "no end")
    again = next(source)
    assert isinstance(again, StampedPair)
    # The clock is read for each pair, and for the pair read when the source opens.
    assert again.left_stamp == 6_000_000
    # An image that is unreadable or not of 8 bit is dropped with its partner.
    (right / "001.png").write_bytes(b"no image")
    cv2.imwrite(str(left / "002.png"), np.full((48, 64), 3000, np.uint16))
    assert levels_of(opened(left, right))[0] == [0, -1, -1]


def write_video(path: Path, count: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()
    return path


def test_a_longer_or_cut_off_video_is_reported(tmp_path: Path) -> None:
    left, right = write_video(tmp_path / "left.avi", 6), write_video(tmp_path / "right.avi", 4)
    levels, missing = levels_of(opened(left, right))
    np.testing.assert_allclose(levels, [0, 40, 80, 120], atol=3)
    assert missing == "2 images without a partner: left 000004, left 000005"
    whole = left.read_bytes()
    for path in (left, right):
        path.write_bytes(whole[: whole.index(b"movi") + (len(whole) - whole.index(b"movi")) // 2])
    levels, missing = levels_of(opened(left, right))
    assert len(levels) < 6
    assert f"{6 - len(levels)} of 6 pairs cannot be read" in missing


def test_wrong_sources_are_rejected(tmp_path: Path) -> None:
    left, right = write_pairs(tmp_path / "good", 2)
    other = write_pairs(tmp_path / "large", 2, (80, 60))[0]
    (tmp_path / "empty").mkdir()
    for pair, cause in (
        (("", right), "left is empty"),
        ((left, tmp_path / "none"), "does not exist"),
        ((left, tmp_path / "empty"), "no images"),
        ((left, 0), "one is a camera"),
        ((3, 3), "same camera"),
        (("/dev/no_camera", "/dev/no_other"), "/dev/no_camera does not exist"),
        ((left, other), "80x60"),
        (("/dev/null", "/dev/zero"), "left camera /dev/null cannot be opened"),
    ):
        with pytest.raises(UserError, match=cause):
            opened(*pair)
    (left / "000.png").unlink()
    with pytest.raises(UserError, match=r"right 000\.png"):
        opened(left, right)
