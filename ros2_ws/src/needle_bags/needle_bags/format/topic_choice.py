"""Selection of topics by name and by regular expressions."""

from __future__ import annotations

import dataclasses
import re

from needle_core.errors import UserError


@dataclasses.dataclass(frozen=True)
class TopicChoice:
    """A selection of topics; all without names and expressions.

    Attributes
    ----------
    names : tuple of str
        Absolute names, selected regardless of `exclude_regex`.
    regex : str
        Also selects matching names; empty: none.
    exclude_regex : str
        Excludes matching names; empty: none.

    Raises
    ------
    UserError
        If an expression is invalid.
    """

    names: tuple[str, ...] = ()
    regex: str = ""
    exclude_regex: str = ""

    def __post_init__(self) -> None:
        """Check the expressions."""
        for text in (self.regex, self.exclude_regex):
            try:
                re.compile(text)
            except re.error as error:
                raise UserError(f"{text!r} is not a regular expression: {error}") from error

    def __contains__(self, name: str) -> bool:
        """Return whether a topic of this absolute name is selected."""
        if name in self.names:
            return True
        if self.exclude_regex and re.search(self.exclude_regex, name):
            return False
        if self.regex:
            return re.search(self.regex, name) is not None
        return not self.names
