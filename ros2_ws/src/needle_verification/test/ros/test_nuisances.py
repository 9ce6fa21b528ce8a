"""What others send holds nothing up: a small version of `scripts/verify D --only nuisances`."""

from __future__ import annotations

from pathlib import Path

import rclpy

from needle_common.process.ros_domain import own_domain
from needle_verification.ros.nuisance_trials import nuisance_trials

# Before a bound, a request of 20,000 names took most of a second, on an idle machine.
GENEROUS = 0.7


def test_long_requests_and_names_hold_up_neither_cycle_nor_emergency_stop(tmp_path: Path) -> None:
    with own_domain() as domain:
        rclpy.init(args=[], domain_id=domain)
        try:
            seen = list(nuisance_trials(tmp_path, domain, ("parameters", "name"), 1.0))
        finally:
            rclpy.try_shutdown()
    assert [outcome["nuisance"] for outcome in seen] == ["parameters", "name"]
    for outcome in seen:
        assert outcome["longest_cycle_s"] < GENEROUS
        assert outcome["estop_heard_s"] < GENEROUS
