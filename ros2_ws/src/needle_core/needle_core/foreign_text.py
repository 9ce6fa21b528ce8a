"""Names and sentences that others sent, as logs and messages may carry them."""

from __future__ import annotations

from collections.abc import Sequence


def plain(text: str, longest: int = 64) -> str:
    """Return foreign text in one line of bounded length.

    Parameters
    ----------
    text : str
        What somebody sent.
    longest : int
        How many characters of it are kept; `...` stands for the rest.

    Returns
    -------
    str
        The text, `?` for each character that does not print.
    """
    kept = text[:longest]
    if not kept.isprintable():
        kept = "".join(sign if sign.isprintable() else "?" for sign in kept)
    return kept if len(text) <= longest else kept + "..."


def plain_list(names: Sequence[str], most: int = 4) -> str:
    """Return foreign names one after the other, how many more there are, or `none`.

    Parameters
    ----------
    names : sequence of str
        What somebody sent.
    most : int
        How many of them are told.
    """
    told = [plain(name) for name in names[:most]]
    if len(names) > most:
        told.append(f"and {len(names) - most} more")
    return ", ".join(told) or "none"
