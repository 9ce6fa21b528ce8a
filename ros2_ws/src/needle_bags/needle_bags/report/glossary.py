"""The words of the report that not everybody knows, each explained where it stands first."""

from __future__ import annotations

import html
import re

from markupsafe import Markup

from needle_bags.report.html_page import parts

TERMS = {
    "r1": "the tip's distance from the wanted plane, positive on its upper side",
    "pitch": "r2, the angle between the needle at its tip and the wanted plane",
    "roll": "r3, the angle to which the bevel has been turned about the needle",
    "bevel": "the slanted end of the needle; the needle bends towards its point as it goes in",
    "truth": "what the simulation knows and no node is told",
    "estimate": "what the controller believes from tips, joints and its model of the needle",
    "measured": "said by the tracker from the images, or by the simulated sensor without images",
    "exposure": "one look of both cameras, or of the simulated sensor",
    "RMS": "root of the mean square: the usual size of an error, whichever way it goes",
    "95 %": "95 of 100 values are smaller",
    "sigma": "standard deviation: of errors without a favourite side, 95 of 100 are within 2 sigma",
    "innovation": "measured minus expected tip: what a measurement tells that was not known",
    "gate": "what refuses a tip that no needle can have: too far from the entry point, or from the "
    "last tip, for how far the needle was moved",
    "doubtful": "the controller's word for a tip that may well be more than 1 mm off; else "
    "it is trusted",
    "hold": "the needle moves only while somebody presses",
    "watchdog": "ends what waits too long for a message; it goes by real time, so a run in which "
    "one tripped may not repeat exactly",
    "step": "the stretch of insertion from one command to the next, 1 mm by default",
    "rerun": "recorded tips or images through today's code; nothing moves",
}
"""Term to its meaning, as half a sentence."""

_MARK = re.compile(r"\[([^\]|]+)(?:\|([^\]]+))?\]")


class Glossary:
    """Explains each term once on a page, below the text that uses it first.

    A text marks a term with brackets: `[roll]`, or `[rolled|roll]` where the words differ. In the
    page it is a link to its explanation.
    """

    def __init__(self) -> None:
        self._explained: set[str] = set()

    def explain(self, text: str) -> Markup:
        """Return a text with marks as a paragraph, and below it what its new terms mean: HTML.

        Raises
        ------
        KeyError
            A marked term has no explanation.
        """
        new: dict[str, str] = {}

        def link(found: re.Match[str]) -> str:
            shown, term = found[1], found[2] or found[1]
            if term not in self._explained:
                new[term] = TERMS[term]
                self._explained.add(term)
            return str(parts.term(shown, term))

        marked = Markup(_MARK.sub(link, html.escape(text, quote=False)))
        return parts.note(marked) + parts.terms(new)
