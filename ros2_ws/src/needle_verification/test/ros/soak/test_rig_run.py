"""The virtual rig: an undisturbed run converges, a seed gives one run, planted bugs are found."""

from __future__ import annotations

import pytest

from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_verification.ros.soak.rig_run import RunResult, run, schedule_of
from needle_verification.soak.faults import STRANGER, Fault, Kind


def violated(result: RunResult) -> set[str]:
    return {violation.invariant for violation in result.violations}


def test_an_undisturbed_run_converges_and_a_seed_gives_one_run() -> None:
    one = run(20, schedule_of(20))
    assert not one.faults
    assert one.inserted
    assert not one.violations
    assert run(20, []).digest == one.digest


@pytest.mark.parametrize("seed", [4, 7])
def test_faults_violate_nothing(seed: int) -> None:
    result = run(seed, schedule_of(seed))
    assert result.faults
    assert not result.violations


def test_a_hold_that_never_grows_old_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Hold, "is_fresh", lambda hold, _: hold.owner is not None)
    monkeypatch.setattr(Hold, "lapses", lambda *_: False)
    # The hand lets go while the operator, which would say so, stands still.
    faults = [
        Fault("operator", Kind.STUCK, 2.0, 2.0, 0.5),
        Fault("person", Kind.OFF, 2.1, 2.0, 0.5),
    ]
    assert "no_motion_without_hold" in violated(run(8, faults))


def test_a_fault_without_a_word_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    fail = DeviceCore.fail
    monkeypatch.setattr(DeviceCore, "fail", lambda core, _, rule=None: fail(core, "", rule))
    faults = [
        Fault(f"{STRANGER}/device/estop", Kind.WRONG, 2.0, 1.0, 0.5),
        Fault("insertion drive", Kind.GARBAGE, 4.0, 1.0, 0.5),
    ]
    assert "faults_are_named" in violated(run(8, faults))
