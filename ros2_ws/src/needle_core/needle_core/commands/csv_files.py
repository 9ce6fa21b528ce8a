"""CSV files with column names in the first line; every error is one line."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from needle_core.commands.options import number
from needle_core.errors import UserError
from needle_core.files.yaml_files import read_text


def read_rows(path: Path, columns: Iterable[str]) -> list[tuple[str, dict[str, str]]]:
    """Return each row of a CSV file: its place, for error messages, and its cells by column.

    Parameters
    ----------
    path : Path
        The file.
    columns : iterable of str
        Required columns; others may be present.

    Raises
    ------
    UserError
        Unreadable, a required column missing, or a row with more fields than columns.
    """
    reader = csv.DictReader(read_text(path).splitlines(), restval="")
    reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
    for column in columns:
        if column not in reader.fieldnames:
            there = ", ".join(reader.fieldnames)
            raise UserError(f"{path}: column {column} is missing (has {there})")
    rows = []
    for row in reader:
        where = f"{path}, line {reader.line_num}"
        if None in row:
            raise UserError(f"{where}: more fields than columns")
        rows.append((where, {column: text.strip() for column, text in row.items()}))
    return rows


def read_lengths(path: Path, columns: tuple[str, ...]) -> dict[str, list[float] | None]:
    """Return lengths [m] by name; None for a name whose cells are empty.

    Parameters
    ----------
    path : Path
        CSV with the column `name`.
    columns : tuple of str
        Columns of the lengths.

    Raises
    ------
    UserError
        As `read_rows`; a value that is not a number or out of bounds, or a duplicate name.
    """
    found: dict[str, list[float] | None] = {}
    for where, row in read_rows(path, ("name", *columns)):
        if row["name"] in found:
            raise UserError(f"{where}: {row['name']!r} is a duplicate")
        is_empty = not any(row[column] for column in columns)
        found[row["name"]] = (
            None
            if is_empty
            else [number(f"{where}: {c}", row[c], -10.0, 10.0, "m") for c in columns]
        )
    return found


def read_insertions(path: Path) -> dict[str, float]:
    """Return insertions [m] by name, of a CSV `name,insertion_m`, without names that have none.

    Raises
    ------
    UserError
        As `read_lengths`.
    """
    read = read_lengths(path, ("insertion_m",))
    return {name: values[0] for name, values in read.items() if values is not None}
