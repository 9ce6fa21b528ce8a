"""Session files: valid and invalid content."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import (
    HELD_FREELY,
    Place,
    load_session,
    parse_session,
)
from needle_tracker.optics.calibration import SIDES
from synthetic_rig import BOARD, GIVEN_BOX, PLACES, STANDS, flat_pose, session_content

FLAT = {"origin": [0.018, -0.04, 0.01]}


def entry(place: Place) -> dict[str, Any]:
    T = place.T_rig_board
    content = {"origin": T[:3, 3].tolist(), "columns": T[:3, 0].tolist(), "rows": T[:3, 1].tolist()}
    return content | {"under_surface": place.under_surface, "sigma": place.sigma}


def box_content(**places: Any) -> dict[str, Any]:
    """Return a session file with a window for each camera instead of the phantom."""
    content = session_content(**places)
    del content["phantom"]
    for side, window in zip(SIDES, GIVEN_BOX, strict=True):
        values = {"point": window.point.tolist(), "normal": window.normal.tolist()}
        layers = [dataclasses.asdict(layer) for layer in window.layers]
        content[side] = {"window": values | {"layers": layers, "inside": window.inside}}
    return content


def test_a_session_is_read(tmp_path: Path) -> None:
    path = tmp_path / "session.yaml"
    path.write_text(yaml.safe_dump(session_content(**{n: entry(p) for n, p in PLACES.items()})))
    read = load_session(path)
    assert read.board == BOARD
    assert [w.inside for w in read.windows] == [1.33, 1.33]
    for name, place in PLACES.items():
        found = read.place_of(name)
        np.testing.assert_allclose(found.T_rig_board, place.T_rig_board, atol=1e-12)
        assert (found.under_surface, found.sigma) == (place.under_surface, place.sigma)
    assert read.place_of("free_1") is HELD_FREELY


def test_a_session_has_windows_and_boards_in_the_box() -> None:
    places = {"stand": entry(STANDS), "box_*": {"under_surface": True}}
    session = parse_session(box_content(**places))
    for window, given in zip(session.windows, GIVEN_BOX, strict=True):
        assert window.normal.tolist() == given.normal.tolist()
        assert (window.layers, window.inside) == (given.layers, given.inside)
    held, stands = session.place_of("box_07"), session.place_of("stand")
    assert (held.under_surface, held.is_known) == (True, False)
    assert (stands.under_surface, stands.is_known, stands.sigma) == (True, True, 0.0)


def test_places_are_found_by_name_or_pattern_and_lie_flat_by_default() -> None:
    session = parse_session(session_content(**{"on_17.*": FLAT, "on_17.5": FLAT, "on_18.*": FLAT}))
    place = session.place_of("on_17.5")
    assert place is session.places["on_17.5"]
    np.testing.assert_allclose(place.T_rig_board, flat_pose([0.018, -0.04, 0.01]), atol=1e-12)
    assert session.place_of("on_18.25") is session.places["on_18.*"]
    assert session.place_of("on_17") is HELD_FREELY


def test_a_wrong_place_is_named() -> None:
    place: dict[str, Any]
    for place, cause in (
        ({}, "places.a.origin"),
        (FLAT | {"colums": [0, 0, 1]}, "unknown key 'colums'"),
        (FLAT | {"columns": [0, 1, 1]}, "right angles"),
        (FLAT | {"rows": [0, -1, 0]}, "faces downwards"),
        (FLAT | {"sigma": -1.0}, "places.a.sigma"),
        (FLAT | {"under_surface": True}, "above the surface"),
        ({"origin": [0.0, 0, 0]}, "below the surface"),
        ({"origin": [0.0, 0, 0], "under_surface": "yes"}, "not true or false"),
        ({"under_surface": True, "sigma": 1e-4}, "places.a.origin"),
    ):
        with pytest.raises(UserError, match=cause):
            parse_session(session_content(a=place))
    for place, cause in (
        # In a box, level, print up: the camera at the side sees the board edge-on.
        ({"origin": [0.0, -0.04, 0.01]}, "away from the camera"),
        ({"origin": [0.03, -0.01, 0.01], "rows": [-1, 1, 0]}, "above the surface"),
    ):
        with pytest.raises(UserError, match=cause):
            parse_session(box_content(a=place | {"under_surface": True}))
    with pytest.raises(UserError, match="the file is missing or not a mapping"):
        parse_session([])
