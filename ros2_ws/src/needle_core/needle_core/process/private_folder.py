"""Folders whose content nobody but their owner can have written."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

PRIVATE = 0o700
_WRITABLE_BY_OTHERS = 0o022
_OPEN_TO_OTHERS = 0o077


def private_folder(place: Path, *names: str) -> Path | None:
    """Return a folder that only this user can read and write, made where it is missing.

    The first of `names` is the folder that shuts others out: it must be this user's, with mode
    0700. What lies below is behind it, and must be folders of this user too. `place` itself may not
    be one where others could put another folder in its stead. No link is followed below `place`.

    Parameters
    ----------
    place : Path
        The folder of others' making that it lies in, `~/.cache` say.
    names : str
        Folders below it, from the outermost on.

    Returns
    -------
    Path or None
        The innermost folder; None where one is not as it must be, or cannot be made.
    """
    folder = place
    try:
        place.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
        if not _keeps_its_names(place.stat()):
            return None
        for name in names:
            folder = folder / name
            with contextlib.suppress(FileExistsError):
                folder.mkdir(mode=PRIVATE)
            if not _is_private(folder.lstat()):
                return None
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def _keeps_its_names(status: os.stat_result) -> bool:
    """Return whether others cannot rename or replace what this user has in a folder."""
    if status.st_uid not in (os.getuid(), 0):
        return False
    return not status.st_mode & _WRITABLE_BY_OTHERS or bool(status.st_mode & stat.S_ISVTX)


def _is_private(status: os.stat_result) -> bool:
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.getuid()
        and not status.st_mode & _OPEN_TO_OTHERS
    )
