"""Which of the topics that there are: by name, by regular expression, and without which."""

from __future__ import annotations

import dataclasses
import re

from needle_core.errors import UserError


@dataclasses.dataclass(frozen=True)
class TopicChoice:
    """A choice of topics; all where neither names nor an expression are given.

    Attributes
    ----------
    names : tuple of str
        Absolute names. They are chosen whatever is excluded.
    regex : str
        Names in which it is found are chosen too; empty: none.
    exclude_regex : str
        Names in which it is found are not chosen; empty: none is excluded.

    Raises
    ------
    UserError
        If an expression is not one.
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
        """Return whether a topic of this absolute name is chosen."""
        if name in self.names:
            return True
        if self.exclude_regex and re.search(self.exclude_regex, name):
            return False
        if self.regex:
            return re.search(self.regex, name) is not None
        return not self.names
