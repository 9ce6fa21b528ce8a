"""Place in which `verify` and `paper` work: a checkout, and a folder that is kept or not."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from needle_core.errors import UserError


def checkout() -> Path:
    """Return the checkout that this runs from.

    Raises
    ------
    UserError
        If it runs from an installation without one.
    """
    for folder in Path(__file__).resolve().parents:
        if (folder / "scripts" / "simulate").is_file():
            return folder
    raise UserError("this runs from a checkout only: there is no scripts/simulate beside it")


def make_folder(option: str, name: str, *, exist_ok: bool = True) -> Path:
    """Return the folder that an option names, made where it is not there.

    Raises
    ------
    UserError
        If it cannot be made, or is there although it must not be.
    """
    folder = Path(name).expanduser().absolute()
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except OSError as error:
        raise UserError(f"{option} {name}: {error.strerror}") from error
    return folder


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder, and remove it unless a `UserError` ends its use: that may name a log."""
    folder = Path(tempfile.mkdtemp(prefix="needle_work_"))
    try:
        yield folder
    except UserError:
        raise
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)
