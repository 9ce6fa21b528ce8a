"""Images that are missing, broken, black, old, alike or of another camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rclpy.context import Context

from .node_bench import Bench, Images, found


@pytest.mark.parametrize(
    ("spoil", "encoding", "reason"),
    [
        (lambda image: image, "rgb8", "right image has 786432 bytes in rows of 1024"),
        (lambda image: image, "mono16", "right image is 'mono16', wants 8 bits, such as mono8"),
        (lambda image: image[:480, :640], "mono8", "right image is 640x480, the calibration is"),
    ],
)
def test_bad_images_are_answered_without_a_tip_and_named(
    bench: Bench,
    images: Images,
    spoil: Callable[[np.ndarray], np.ndarray],
    encoding: str,
    reason: str,
) -> None:
    bench.joints(10)
    bench.image("left", 10, images[0])
    bench.image("right", 10, spoil(images[1]), encoding)
    pose = bench.answer()
    assert not found(pose)
    assert pose.pose.pose.orientation.w == 1.0
    bench.until(lambda: bench.health["images"][0] == 2 and reason in bench.health["images"][1])
    bench.until(lambda: bench.health["images"][2]["pairs_refused"] == "1")
    assert not bench.tips
    assert found(bench.pair(20, images))


def test_reasons_without_end_are_told_in_a_report_of_bounded_length(bench: Bench) -> None:
    pixels = np.zeros((2, 2), np.uint8)
    count = 50
    for number in range(count):
        bench.joints(10 + number)
        bench.image("left", 10 + number, pixels, f"{number} " + "x" * 3000)
        bench.image("right", 10 + number, pixels)
        assert not found(bench.answer())
    bench.until(lambda: bench.health["images"][2].get("pairs_refused") == str(count))
    last = f"'{count - 1} x"
    bench.until(lambda: all(last in bench.health[part][1] for part in ("images", "track")))
    for part, kind in (("images", "refused: "), ("track", "no tip: ")):
        told = {k: int(v) for k, v in bench.health[part][2].items() if k.startswith(kind)}
        assert sum(told.values()) == count
        assert told[f"{kind}other reasons"] == count - 20
        assert list(told)[-2].startswith(f"{kind}left image is '{count - 1} x")
        assert max(map(len, [*told, bench.health[part][1]])) < 120


def test_an_image_without_all_its_bytes_is_no_tip(bench: Bench, images: Images) -> None:
    bench.joints(10)
    bench.image("left", 10, images[0], cut_off=1)
    bench.image("right", 10, images[1])
    assert not found(bench.answer())
    wanted = "pair refused: left image has 786431 bytes in rows of 1024"
    bench.until(lambda: bench.health["images"][1].startswith(wanted))
    assert not bench.tips


def test_a_black_frame_is_no_tip(bench: Bench, images: Images) -> None:
    assert not found(bench.pair(10, (images[0], np.zeros_like(images[1]))))
    bench.until(lambda: "right image is black" in bench.health["track"][1])
    assert bench.health["track"][0] == 1


def test_time_running_backwards_is_no_tip(bench: Bench, images: Images) -> None:
    assert found(bench.pair(5_000_000_000, images))
    assert not found(bench.pair(4_990_000_000, images))
    bench.until(lambda: "ran backwards" in bench.health["images"][1])
    assert not found(bench.pair(5_000_000_000, images))
    bench.until(lambda: "repeated" in bench.health["images"][1])
    assert found(bench.pair(5_010_000_000, images))
    # Far back a new recording has begun: its first pair is refused, the next is looked at.
    assert not found(bench.pair(1_000_000_000, images))
    assert found(bench.pair(1_010_000_000, images))
    assert len(bench.tips) <= 3


def test_a_camera_that_runs_at_another_resolution_gives_no_tip(
    bench: Bench, images: Images
) -> None:
    bench.camera_info(640, 480)
    bench.until(lambda: bench.health["images"][0] == 2)
    reason = "left camera_info is for 640x480, the calibration for 1024x768"
    assert bench.health["images"][1] == reason
    assert not found(bench.pair(10, images))
    bench.until(lambda: bench.health["images"][1] == f"pair refused: {reason}")
    assert bench.health["images"][2][f"refused: {reason}"] == "1"
    assert not bench.tips
    # A driver that knows nothing contradicts nothing.
    bench.camera_info(0, 0)
    bench.until(lambda: not bench.tracker._health.camera_info["left"])
    assert found(bench.pair(20, images))


def test_a_camera_whose_sensor_is_larger_than_its_images_gives_tips(
    bench: Bench, images: Images
) -> None:
    bench.camera_info(2048, 1536)
    bench.until(lambda: bench.health["images"][0] == 2)
    bench.camera_info(2048, 1536, binning_x=2, binning_y=2)
    bench.until(lambda: not bench.tracker._health.camera_info["left"])
    assert found(bench.pair(10, images))
    bench.camera_info(2048, 1536, binning_x=4, binning_y=2)
    reason = (
        "left camera_info is for 512x768 (sensor 2048x1536, roi 0x0 at 0,0, binning 4x2), "
        "the calibration for 1024x768"
    )
    bench.until(lambda: bench.health["images"][1] == reason)
    assert not found(bench.pair(20, images))


def test_a_calibration_for_another_resolution_gives_no_tip(
    context: Context, images: Images, calibration_path: Path, tmp_path: Path
) -> None:
    text = calibration_path.read_text()
    other = tmp_path / "other.yaml"
    other.write_text(text.replace("image_width: 1024", "image_width: 1280"))
    bench = Bench(context, calibration_file=str(other))
    try:
        assert not found(bench.pair(10, images))
        wanted = "left image is 1024x768, the calibration is for 1280x768"
        bench.until(lambda: bench.health["images"][2].get(f"refused: {wanted}") == "1")
        assert bench.health["images"][:2] == (2, f"pair refused: {wanted}")
        assert not bench.tips
    finally:
        bench.close()


def test_the_same_images_from_both_cameras_are_no_tip(bench: Bench, images: Images) -> None:
    """One camera wired to both topics: its two rays never meet in the phantom."""
    assert not found(bench.pair(10, (images[0], images[0])))
    assert not found(bench.pair(20, (images[1], images[0])))
    bench.until(lambda: bench.health["track"][0] == 1)
    assert not bench.tips


def test_swapped_images_are_suspected_aloud(bench: Bench, images: Images) -> None:
    left, right = images
    for k in range(1, 13):
        assert not found(bench.pair(10 * k, (right, left)))
    bench.until(lambda: "seem to be swapped" in bench.health["images"][1])
    assert bench.health["images"][0] == 1
    assert "parameters left and right" in bench.health["images"][1]
    assert found(bench.pair(1000, images))
    bench.until(lambda: bench.health["images"][0] == 0)
