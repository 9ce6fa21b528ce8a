"""What goes through a bad cable, and what does not."""

from __future__ import annotations

from needle_verification.trials.computers.bad_cable import BadCable


def test_a_frame_comes_after_the_delay_and_in_its_order() -> None:
    cable = BadCable(0.005, 0.0, seed=1)
    assert cable.wait(10.0) is None
    cable.send(b"first", 1, 10.0)
    cable.send(b"second", 0, 10.001)
    assert cable.arrived(10.0049) == []
    assert abs((cable.wait(10.001) or 0.0) - 0.004) < 1e-9
    assert cable.arrived(10.0051) == [(1, b"first")]
    assert cable.arrived(11.0) == [(0, b"second")]


def test_so_many_are_lost() -> None:
    cable = BadCable(0.0, 0.01, seed=1)
    for _ in range(100_000):
        cable.send(b"frame", 0, 0.0)
    # five standard deviations of a binomial
    assert abs(len(cable.arrived(0.0)) - 99_000) < 160


def test_a_cut_takes_what_is_on_its_way_and_all_that_is_sent_until_it_is_mended() -> None:
    cable = BadCable(0.005, 0.0, seed=1)
    cable.send(b"on its way", 0, 1.0)
    cable.cut()
    cable.send(b"meanwhile", 0, 1.001)
    cable.mend()
    cable.send(b"afterwards", 0, 1.002)
    assert cable.arrived(9.0) == [(0, b"afterwards")]
