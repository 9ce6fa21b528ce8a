"""Options of all command lines, and their one-line errors."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from needle_core.commands.options import (
    CommandParser,
    join_signed_values,
    number,
    output_file,
    start,
    whole_number,
)
from needle_core.errors import OutOfBoundsError, UserError


def test_options_cannot_be_abbreviated() -> None:
    parser = CommandParser("study", "", "")
    parser.add_argument("--seed")
    with pytest.raises(UserError, match="unrecognized arguments: --see 1; see --help"):
        parser.parse_args(["--see", "1"])


def test_numbers_are_parsed_and_bounded() -> None:
    assert number("--depth-mm", "120", 1.0, 120.0, "mm") == 120.0
    assert number("--until-mm", "inf", 0.0, math.inf, "mm") == math.inf
    with pytest.raises(OutOfBoundsError, match=r"--depth-mm = 121 mm is outside \[1, 120\] mm"):
        number("--depth-mm", "121", 1.0, 120.0, "mm")
    for text in ("deep", "nan", "-inf", "inf"):
        with pytest.raises(UserError, match="--depth-mm"):
            number("--depth-mm", text, 1.0, 120.0, "mm")
    assert whole_number("--draws", "10", 1, 10) == 10
    for text in ("1.5", "0", "11"):
        with pytest.raises(UserError, match="--draws"):
            whole_number("--draws", text, 1, 10)


def test_an_output_file_needs_an_existing_folder(tmp_path: Path) -> None:
    assert output_file("--json", None) is None
    assert output_file("--json", tmp_path / "new.json") == tmp_path / "new.json"
    assert output_file("--json", "new.json") == Path("new.json")
    for bad in (tmp_path, tmp_path / "missing" / "new.json"):
        with pytest.raises(UserError, match="--json"):
            output_file("--json", bad)


def test_a_start_may_begin_with_a_minus_and_is_bounded() -> None:
    parser = CommandParser("study", "", "")
    parser.add_argument("--initial")
    for text in ("-3,2,15", "-.5,2,15", "50,-45,-180"):
        given = parser.parse_args(join_signed_values(["--initial", text])).initial
        assert start(given, 50.0, 45.0) == tuple(float(part) for part in text.split(","))
    for text in ("-3,2", "-51,0,0", "0,46,0", "0,0,181", "-inf,0,0", "x,0,0"):
        with pytest.raises(UserError, match="--initial"):
            start(text, 50.0, 45.0)
