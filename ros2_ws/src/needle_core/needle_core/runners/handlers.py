"""Handlers of a component, as every runner runs them: one that raises ends nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from needle_core.component import Action, Actions, Diagnose, Log, Output, Publish
from needle_core.diagnostics import Diagnostic, Level


class Handlers:
    """Runs the handlers of a component.

    Parameters
    ----------
    outputs : iterable of Output
        The component's.
    """

    def __init__(self, outputs: Iterable[Output]) -> None:
        self._topics = {output.topic for output in outputs}
        self._failures = 0

    def run(self, work: Callable[[], Actions]) -> list[Action]:
        """Return the actions of a handler; what it did before it failed is done."""
        actions: list[Action] = []
        try:
            for action in work():
                if isinstance(action, Publish) and action.topic not in self._topics:
                    raise ValueError(f"{action.topic} is not among its outputs")
                actions.append(action)
        except Exception as error:  # noqa: BLE001 - whatever a message may lead to
            self._failures += 1
            text = f"internal error: {type(error).__name__}: {error}"
            failed = Diagnostic(Level.ERROR, text, {"failures": str(self._failures)})
            actions += [Log("error", text, kind=text), Diagnose("handlers", failed)]
        return actions
