"""Selection of topics by name and by regular expressions."""

from __future__ import annotations

import dataclasses
import re

from needle_core.errors import UserError


@dataclasses.dataclass(frozen=True)
class TopicChoice:
    """Selection of topics; all topics if there are neither names nor expressions.

    Attributes
    ----------
    names : tuple of str
        Absolute names, selected regardless of `exclude_regex`.
    regex : str
        Expression that selects further names; empty for none.
    exclude_regex : str
        Expression that excludes names; empty for none.

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
