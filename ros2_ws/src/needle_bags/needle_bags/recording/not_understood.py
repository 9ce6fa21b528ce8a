"""Data from outside that made no sense, counted by where they came from."""

from __future__ import annotations

from needle_core.diagnostics import Diagnostic, Level

_MOST_WORDS = 200


class NotUnderstood:
    """Counts of what could not be handled, and why the last of each could not."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._why: dict[str, str] = {}

    def add(self, where: str, error: Exception) -> bool:
        """Count one; return whether it is the first of its place."""
        self._counts[where] = self._counts.get(where, 0) + 1
        text = next(iter(str(error).splitlines()), "")
        self._why[where] = f"{type(error).__name__}: {text}"[:_MOST_WORDS]
        return self._counts[where] == 1

    def diagnostic(self) -> Diagnostic:
        """Return a warning that names them; all is well without any."""
        if not self._counts:
            return Diagnostic(Level.OK, "all understood", {})
        parts = [f"{where} ({self._why[where]})" for where in self._counts]
        values = {where: str(count) for where, count in self._counts.items()}
        return Diagnostic(Level.WARN, f"not understood: {'; '.join(parts)}", values)
