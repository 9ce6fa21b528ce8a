"""Windows of the network's maps."""

from __future__ import annotations

import numpy as np

from needle_tracker.detector.needle_detector import Window


def test_a_part_has_the_values_at_its_place_in_the_image() -> None:
    shaft = np.arange(30.0 * 40.0, dtype=np.float32).reshape(30, 40)
    whole = Window(shaft, -shaft, (100, 50), 2)
    part = whole.part((105, 52, 112, 60))
    assert part is not None
    assert part.shaft.shape == part.ends.shape == (8, 7)
    assert (part.shaft[3, 4], part.ends[3, 4]) == (shaft[5, 9], -shaft[5, 9])
    pixel = np.array([4.0, 3.0])
    np.testing.assert_array_equal(part.point(pixel), whole.point(pixel + np.array([5.0, 2.0])))
    np.testing.assert_allclose(part.pixel(part.point(pixel)), pixel)


def test_a_box_beyond_the_window_is_no_part_of_it() -> None:
    window = Window(np.zeros((30, 40), np.float32), np.zeros((30, 40), np.float32), (100, 50), 1)
    assert window.part((100, 50, 140, 80)) is not None
    for box in ((99, 50, 140, 80), (100, 49, 140, 80), (100, 50, 141, 80), (100, 50, 140, 81)):
        assert window.part(box) is None
