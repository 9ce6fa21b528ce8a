"""Every check of `scripts/verify`, at full size: hours."""

from __future__ import annotations

from pathlib import Path

import pytest

from campaign.checking import Check, Workbench
from campaign.verify import STEPS
from needle_bringup.workplace import checkout

CHECKS = [
    pytest.param(check, id=f"{step}-{check.__name__}")
    for step, checks in STEPS.items()
    for check in checks
]


@pytest.mark.parametrize("check", CHECKS)
def test_a_step_meets_its_requirements(check: Check, tmp_path: Path) -> None:
    bench = Workbench([str(checkout() / "scripts" / "simulate")], tmp_path)
    missed = [finding for finding in check(bench) if not finding.passed]
    assert missed == []
