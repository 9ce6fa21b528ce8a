"""Checkout and output folders of commands."""

from __future__ import annotations

from pathlib import Path

from needle_core.errors import UserError


def checkout() -> Path:
    """Return the checkout that contains this code.

    Raises
    ------
    UserError
        If there is none, because the package is installed.
    """
    for folder in Path(__file__).resolve().parents:
        if (folder / "scripts" / "simulate").is_file():
            return folder
    raise UserError("this runs from a checkout only: scripts/simulate is missing")


def make_folder(option: str, name: str, *, exist_ok: bool = True) -> Path:
    """Return the folder given to an option, created if missing.

    Raises
    ------
    UserError
        If it cannot be created, or exists and `exist_ok` is False.
    """
    folder = Path(name).expanduser().absolute()
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except OSError as error:
        raise UserError(f"{option} {name}: {error.strerror}") from error
    return folder
