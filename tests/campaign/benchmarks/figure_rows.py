"""One row of `scripts/bench`: a figure and its reference from the same run."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Row:
    """Figure and its reference, both in `unit`; `against` names the reference."""

    key: str
    what: str
    unit: str
    value: float
    against: str
    reference: float

    @property
    def ratio(self) -> float:
        """Ratio of the reference to the value."""
        return self.reference / self.value
