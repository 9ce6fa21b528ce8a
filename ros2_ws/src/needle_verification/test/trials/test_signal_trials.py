"""A sample of the signals that `scripts/verify E` sends at full size."""

from pathlib import Path

from needle_verification.trials.signal_trials import signal_trials


def test_all_nodes_end_in_order_after_one_signal_and_after_two(tmp_path: Path) -> None:
    for end in signal_trials(tmp_path, 2, seed=3, latest=3.0):
        assert end.wrong == "", end
        assert end.code in (0, 130), end
        assert end.seconds < 10.0, end
