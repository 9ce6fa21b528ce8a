"""What others send holds nothing up: a small version of `scripts/verify D --only nuisances`."""

from __future__ import annotations

from pathlib import Path

from needle_core.process.ros_domain import own_domain
from needle_verification.ros.listening_node import ros
from needle_verification.ros.nuisance import NUISANCE_KINDS
from needle_verification.ros.nuisance_trials import nuisance_trials
from needle_verification.trials.trial_runner import trials_of

# Seconds; before a bound, a long name took most of one on an idle machine.
GENEROUS = 0.7


def test_long_names_hold_up_neither_cycle_nor_emergency_stop(tmp_path: Path) -> None:
    kinds = ["name"]
    trials = trials_of(NUISANCE_KINDS, kinds, 1, seed=1)
    with own_domain() as domain, ros(domain):
        seen = list(nuisance_trials(tmp_path, domain, trials, 1.0))
    assert [outcome["kind"] for outcome in seen] == kinds
    for outcome in seen:
        assert outcome["longest_cycle_s"] < GENEROUS
        assert outcome["estop_heard_s"] < GENEROUS
