"""What `scripts/bench` compares with must be the same loop."""

from __future__ import annotations

import numpy as np
import pytest

import benchmark
import drive_benchmark
import reference_loop
from needle_bringup.studies.study_controllers import controller_factory
from needle_sim.studies.study import run_study

NEEDLES = (0, 5_000, 9_999)


def test_the_plain_loop_ends_where_the_study_does() -> None:
    # Other code in other words: an oracle for the study, too.
    starts = benchmark.STARTS
    ends = run_study(
        starts, controller_factory("paper", benchmark.TIP_NOISE), benchmark.STUDY
    ).x_end
    design = benchmark.design()
    plain = [
        reference_loop.steer(starts[k].tolist(), benchmark.noise_of(k), design) for k in NEEDLES
    ]
    np.testing.assert_allclose(plain, ends[list(NEEDLES)], atol=1e-9)


def test_python_control_simulates_the_same_loop() -> None:
    design, start = benchmark.design(), benchmark.STARTS[7].tolist()
    noise = benchmark.noise_of(7)[:25]
    system = reference_loop.control_system(design)
    assert reference_loop.control_steer(system, start, noise) == pytest.approx(
        reference_loop.steer(start, noise, design), abs=1e-12
    )


@pytest.mark.parametrize("key", drive_benchmark.WAYS)
def test_every_way_to_the_drives_is_measured_to_its_sync(key: str) -> None:
    delays, share = drive_benchmark.measure(drive_benchmark.WAYS[key][1], 8)
    assert len(delays) == 8
    assert min(delays) > 0.0
    assert share > 0.0
