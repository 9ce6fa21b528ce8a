"""The reference loops of `scripts/bench` compute the same as the study."""

from __future__ import annotations

import numpy as np
import pytest

from campaign.benchmarks import drive_benchmark, reference_loop, study_benchmark
from needle_bringup.studies.study_controllers import controller_factory
from needle_sim.studies.study import run_study

NEEDLES = (0, 5_000, 9_999)


def test_the_plain_loop_ends_where_the_study_does() -> None:
    # Independent code: also an oracle for the study.
    starts = study_benchmark.STARTS
    ends = run_study(
        starts, controller_factory("paper", study_benchmark.TIP_NOISE), study_benchmark.STUDY
    ).x_end
    design = study_benchmark.design()
    plain = [
        reference_loop.steer(starts[k].tolist(), study_benchmark.noise_of(k), design)
        for k in NEEDLES
    ]
    np.testing.assert_allclose(plain, ends[list(NEEDLES)], atol=1e-9)


def test_python_control_simulates_the_same_loop() -> None:
    design, start = study_benchmark.design(), study_benchmark.STARTS[7].tolist()
    noise = study_benchmark.noise_of(7)[:25]
    system = reference_loop.control_system(design)
    assert reference_loop.control_steer(system, start, noise) == pytest.approx(
        reference_loop.steer(start, noise, design), abs=1e-12
    )


@pytest.mark.parametrize("name", drive_benchmark.CLIENTS)
def test_each_client_is_measured_until_the_sync(name: str) -> None:
    delays, share = drive_benchmark.measure(drive_benchmark.CLIENTS[name], 8)
    assert len(delays) == 8
    assert min(delays) > 0.0
    assert share > 0.0
