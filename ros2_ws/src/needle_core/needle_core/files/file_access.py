"""Access to regular files, but not links: reading without blocking, and atomic replacement."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import uuid
from pathlib import Path
from typing import BinaryIO

from needle_core.errors import UserError


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading, without blocking.

    Raises
    ------
    OSError
        If it does not exist, or is a link, a pipe or a device.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "it is a link, which is not followed", str(path)) from error
        raise
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return os.fdopen(number, "rb")


def write_text(path: Path, text: str) -> None:
    """Write a text file; raise a `UserError` with the reason if that fails."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def make_folder(folder: Path) -> None:
    """Create a folder, or accept an empty one; raise a `UserError` with the reason if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UserError(f"{folder} is not empty: give a new folder")
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror}") from error


def replace_file(path: Path, data: bytes) -> None:
    """Write a file atomically and flush it to the disk; a link of that name is replaced.

    Raises
    ------
    OSError
        If writing fails; an existing file stays as it is.
    """
    new = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with new.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        new.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    sync_directory(path.parent)


def sync_directory(directory: Path) -> None:
    """Flush a directory's entries to the disk."""
    number = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(number)
    finally:
        os.close(number)
