from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import load_session, parse_session

from .session import session_content
from .synthetic_rig import flat_pose, surface_places, under_places


def content(**places: Any) -> dict[str, Any]:
    return session_content({}) | {"places": places}


def test_a_place_written_is_the_place_read() -> None:
    places = {**surface_places(0.0175), **under_places(0.0175)}
    read = parse_session(session_content(places))
    for name, place in places.items():
        found = read.place_of(name)
        assert found is not None
        np.testing.assert_allclose(found.T_rig_board, place.T_rig_board, atol=1e-12)
        assert (found.under_surface, found.sigma) == (place.under_surface, place.sigma)
    assert read.place_of("free_1") is None


def test_by_default_a_board_lies_flat_along_the_insertion() -> None:
    session = parse_session(content(**{"on_*": {"origin": [0.018, -0.04, 0.01]}}))
    place = session.place_of("on_top_3")
    assert place is not None
    np.testing.assert_allclose(place.T_rig_board, flat_pose([0.018, -0.04, 0.01]), atol=1e-12)


def test_a_name_may_have_dots() -> None:
    flat = {"origin": [0.018, -0.04, 0.01]}
    session = parse_session(content(**{"on_17.5": flat, "on_18.*": flat}))
    assert session.place_of("on_17.5") is session.places["on_17.5"]
    assert session.place_of("on_18.25") is session.places["on_18.*"]
    assert session.place_of("on_17") is None


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ({}, "places.a.origin"),
        ({"origin": [0, 0]}, "places.a.origin wants 3 numbers, has 2"),
        ({"origin": [0.018, 0, float("nan")]}, "places.a.origin .* not a finite number"),
        ({"origin": [0.018, 0, 0], "colums": [0, 0, 1]}, "unknown key 'colums'"),
        ({"origin": [0.018, 0, 0], "columns": [0, 1, 1]}, "right angles"),
        ({"origin": [0.018, 0, 0], "columns": [0, 0, 0]}, "right angles"),
        ({"origin": [0.018, 0, 0], "rows": [0, -1, 0]}, "faces downwards"),
        ({"origin": [0.018, 0, 0], "sigma": -1.0}, "places.a.sigma"),
        ({"origin": [0.018, 0, 0], "under_surface": True}, "above the surface"),
        ({"origin": [0.0, 0, 0]}, "below the surface"),
        ({"origin": [0.0, 0, 0], "under_surface": "yes"}, "not true or false"),
    ],
)
def test_a_wrong_place_is_named(place: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        parse_session(content(a=place))


def test_a_file_that_is_no_session(tmp_path: Any) -> None:
    path = tmp_path / "session.yaml"
    with pytest.raises(UserError, match="cannot be read: No such file"):
        load_session(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not a text file"):
        load_session(path)
    path.write_text("a: [")
    with pytest.raises(UserError, match="not YAML"):
        load_session(path)
    path.write_text("[]")
    with pytest.raises(UserError, match="not a mapping"):
        load_session(path)
