"""A sample of what `scripts/verify E` runs at full size; times are not judged here."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_verification.checks.check_bags import bag_findings
from needle_verification.trials.recording_trials import record_and_kill, record_full_rate


def test_nothing_is_missing_at_full_rate(tmp_path: Path) -> None:
    seen = record_full_rate(tmp_path, 3.0, burners=0)
    assert seen.exit_code == 0
    assert seen.sent["/stereo/left/image_raw"] > 20
    assert {topic: count for topic, count in seen.missing.items() if count} == {}
    assert seen.counted == {}
    assert [finding.seen for finding in bag_findings("bag", seen.bag) if not finding.passed] == []


@pytest.mark.parametrize("images", [True, False])
def test_what_a_killed_recorder_leaves_is_recovered(tmp_path: Path, images: bool) -> None:
    for killed in record_and_kill(tmp_path, 1, seed=11, images=images):
        assert killed.unreadable == ""
        assert killed.gaps == 0
        assert killed.messages > 10
