"""One row of `scripts/bench`: a figure beside its reference of the same run."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Row:
    """A figure and its reference, both in `unit`; `against` names the reference."""

    key: str
    what: str
    unit: str
    value: float
    against: str
    reference: float

    @property
    def ratio(self) -> float:
        """Ratio of the value to the reference."""
        return self.reference / self.value
