"""Detection of bags and their files, and errors that explain why a bag cannot be read."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any, Final

from needle_core.errors import UserError
from needle_core.files.file_access import open_regular
from needle_core.files.yaml_files import load_yaml

METADATA_FILE: Final = "metadata.yaml"
_DATA_FILE: Final = re.compile(r"([^.].*?)(?:_(\d+))?\.mcap(?:\.zstd)?")


class BrokenBagError(UserError):
    """Bag that is damaged or was not completed; the message names the remedy.

    Parameters
    ----------
    path : Path
        The bag.
    reason : str
        The fault.
    state : str
        State of the bag in a few words.
    """

    def __init__(self, path: Path, reason: str, state: str = "is broken") -> None:
        super().__init__(f"{path}: the bag {state} ({reason}): {repair_hint(path)}")
        self.reason = reason


def recover_hint(path: Path) -> str:
    """Return the command that repairs an MCAP bag."""
    return f"run `ros2 run needle_bags recover {path}`"


def repair_hint(path: Path) -> str:
    """Return the command that repairs a bag, by the type of its files."""
    if any(path.glob("*.db3*")) and not any(path.glob("*.mcap")):
        return f"`recover` repairs MCAP only; SQLite needs `ros2 bag reindex {path}`"
    return recover_hint(path)


def recording_files(folder: Path) -> list[Path]:
    """Return the files of a folder's only MCAP recording: `<stem>.mcap` or `<stem>_<n>.mcap`.

    If there are several stems, the one with the folder's name is the recording. If numbers are
    missing in the sequence, the result includes the first missing file, which does not exist.

    Raises
    ------
    UserError
        If there are several recordings and none has the folder's name.
    """
    stems: dict[str, dict[tuple[int, str], Path]] = {}
    for file in sorted(folder.iterdir()):
        if match := _DATA_FILE.fullmatch(file.name):
            key = (int(match[2] or 0), file.name.removesuffix(".zstd"))
            stems.setdefault(match[1], {}).setdefault(key, file)
    stem = folder.absolute().name
    if len(stems) > 1 and stem not in stems:
        names = ", ".join(next(iter(files.values())).name for files in stems.values())
        count = "two" if len(stems) == 2 else len(stems)
        raise UserError(
            f"{folder}: {count} recordings in one folder ({names}) and no {METADATA_FILE}: "
            "give each a folder of its own, or name one of the files"
        )
    stem = stem if stem in stems else next(iter(stems), stem)
    files = stems.get(stem, {})
    for (before, _), (number, _) in pairwise(sorted(files)):
        if number > before + 1:
            name = f"{stem}_{before + 1}.mcap"
            files[before + 1, name] = folder / name
    return [file for _, file in sorted(files.items())]


def require_bag(path: Path) -> None:
    """Raise a `UserError` if a path is neither a bag with metadata.yaml nor an MCAP file."""
    if path.is_file():
        if ".mcap" not in path.suffixes[-2:]:
            meant = f", {path.absolute().parent}" if path.name == METADATA_FILE else ""
            raise UserError(f"{path} is a file: name an .mcap file or the bag's directory{meant}")
    elif not path.is_dir():
        raise UserError(f"{path}: no such bag directory")
    elif os.path.lexists(path / METADATA_FILE):
        return
    files = [path] if path.is_file() else recording_files(path)
    if any(is_being_recorded(file) for file in files):
        raise UserError(f"{path}: the bag is still being recorded")
    if path.is_dir():
        if not files and not any(path.glob("*.db3")):
            raise UserError(f"{path} is not a bag: it has no {METADATA_FILE}")
        raise BrokenBagError(path, f"{METADATA_FILE} is missing", "was not completed")


def is_being_recorded(file: Path) -> bool:
    """Return whether a recorder is writing a data file."""
    try:
        with open_regular(file) as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn every error of a reader into a `BrokenBagError` of one line."""
    try:
        yield
    except (UserError, GeneratorExit):
        raise
    # Broken bags cause all kinds of exceptions: assertions, struct errors, KeyError...
    except Exception as error:
        lines = str(error).splitlines()
        reason = lines[0].rstrip(".")[:200] if lines else type(error).__name__
        if isinstance(error, OSError):
            reason = error.strerror or reason
            if error.filename:
                reason = f"{PurePath(os.fsdecode(error.filename)).name}: {reason}"
        raise BrokenBagError(path, reason) from error


def read_information(path: Path) -> dict[str, Any]:
    """Return the content of metadata.yaml.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, or does not have the form of rosbag2.
    """
    with open_regular(path / METADATA_FILE) as stream:
        data = stream.read()
    try:
        document = load_yaml(data.decode())
    except ValueError as error:
        raise ValueError(f"{METADATA_FILE}: {error}") from error
    information = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else 0
    if not isinstance(information, dict):
        raise ValueError(f"{METADATA_FILE} is not what rosbag2 writes")
    return information
