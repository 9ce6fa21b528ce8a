"""Errors of scripts/setup, each in one line: machines that do not do, and what a log tells."""

from __future__ import annotations

import errno
import platform
import re
import shutil
from pathlib import Path

# PyPI's ROS wheels are built for manylinux_2_28.
OLDEST_GLIBC = (2, 28)
# The environment itself, and pip's downloads until they are unpacked.
NEEDED_BYTES = 1_800_000_000


class SetupError(Exception):
    """Something is missing; the message is the one line that says what."""


SYMPTOMS = (
    (r"No space left on device|Disk quota exceeded", "disk full"),
    (r"DO NOT MATCH THE HASHES", "the index serves another file than the lock pins"),
    (
        r"Retrying \(Retry|ConnectionError|Name or service not known|failure in name|timed out",
        "no network: the package index cannot be reached",
    ),
    (r"No matching distribution found for (\S+)", "the package index has no {}"),
    (r"ensurepip.*(returned non-zero|No module)", "no working ensurepip: install python3-venv"),
    (r"(?m)^((?:ModuleNotFound|Import)Error: .*)$", "{}"),
)


def explain(what: str, log: Path) -> str:
    """Return one line on a failed command, with the cause where its log shows a known one."""
    last = log.read_text("utf-8").rpartition("\n$ ")[2]
    for pattern, cause in SYMPTOMS:
        found = re.search(pattern, last)
        if found:
            what += f": {cause.format(*found.groups())}"
            break
    return f"{what}; all output is in {log}"


def check_machine(mode: str) -> None:
    """Refuse a C library that the wheels cannot run on.

    Raises
    ------
    SetupError
        If there is no glibc, or an old one.
    """
    if mode == "ros":
        return
    name, version = platform.libc_ver()
    found = tuple(int(part) for part in re.findall(r"\d+", version)[:2])
    if name != "glibc" or found < OLDEST_GLIBC:
        raise SetupError(
            "the wheels need glibc {}.{} or newer".format(*OLDEST_GLIBC)
            + f"; this system has {f'{name} {version}' if name else 'another C library'}"
        )


def check_space(folder: Path) -> None:
    """Refuse to begin what cannot end.

    Raises
    ------
    SetupError
        If the file system has too little space.
    """
    free = shutil.disk_usage(folder).free
    if free < NEEDED_BYTES:
        raise SetupError(
            f"disk full: {folder} has {free / 1e9:.1f} GB free, needs {NEEDED_BYTES / 1e9:.1f} GB"
        )


def describe(error: OSError, folder: Path) -> str:
    """Return one line on a file that cannot be written, below this folder at least."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"disk full: {error.filename or folder}"
    return f"cannot write {error.filename or folder}: {error.strerror}"
