"""Step I: the needle goes in continuously, as fast as a person wants, or pushed by hand."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator

import numpy as np

from campaign.checking import Check, Finding, Workbench, payloads
from campaign.trials.holds.hand_profiles import FASTEST, changing, constant, pushing
from campaign.trials.steered_needle import Hand, SteeredNeedle, rms_at_end
from needle_bringup.descendants import ran
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.files.installed import find_executable
from needle_sim.rig.bench import SimulatedBench

SEED = 1400
LATENCY, TIP_PERIOD = 0.033, 1.0 / 30.0
_OFFSET = 0.003
_TIP_STD = 5e-5
"""Of a tip by the cameras [m]."""
_LONGEST = 550.0
_SAME_TOPICS = ("/needle/tip", "/device/joint_trajectory", "/device/result", "/sim/tip_pose")


@dataclasses.dataclass(frozen=True)
class Size:
    """Sizes of everything that is run.

    Attributes
    ----------
    seeds : int
        Needles of each kind of hand.
    draws : int
        Runs of each study from each of its 1000 starts.
    levels : tuple of str
        At which a whole graph runs, twice each.
    depth_mm : float
        Of those.
    """

    seeds: int = 20
    draws: int = 10
    levels: tuple[str, ...] = ("camera", "drive")
    depth_mm: float = 120.0


FULL = Size()
HANDS: dict[str, tuple[float, Callable[[np.random.Generator], Callable[[float], Hand]]]] = {
    "0.5 mm/s": (0.06, lambda _: constant(0.0005)),
    "2 mm/s": (0.06, lambda _: constant(0.002)),
    "5 mm/s": (0.06, lambda _: constant(FASTEST)),
    "0 to 5 mm/s, stops, releases": (0.06, changing),
    "pushed, jerks to 20 mm/s": (0.25, pushing),
}


def steer(
    hand: Callable[[float], Hand], seed: int, *, pushed: bool, latency: float = LATENCY
) -> SteeredNeedle:
    """Return a needle at its end, in one process, its tip seen to 0.05 mm."""
    settings = SteeringSettings(
        insertion="continuous",
        target_offset=_OFFSET,
        nominal_speed=FASTEST,
        tip_covariance="configured",
        tip_noise="normal",
        measurement_std=_TIP_STD,
    )
    rng = np.random.default_rng([seed, 1])
    bench = SimulatedBench(
        curvature=settings.curvature * rng.uniform(0.95, 1.05),
        pitch=math.radians(rng.uniform(-5.0, 5.0)),
        roll=math.radians(rng.uniform(-20.0, 20.0)),
        torsion_play=0.0,
        torsion_lag=0.0,
        tip_noise=0.0,
        seed=seed,
    )
    noise = np.random.default_rng([seed, 2])
    needle = SteeredNeedle(
        settings,
        bench,
        hand,
        tip_period=TIP_PERIOD,
        latency=latency,
        pushed=pushed,
        measure=lambda _: bench.tip + noise.normal(scale=_TIP_STD, size=3),
    )
    needle.run(_LONGEST)
    return needle


def hands(_: Workbench, size: Size = FULL) -> Iterator[Finding]:
    """Steer while a person goes fast, slowly, stops, lets go, or pushes the needle itself."""
    for name, (bound, new_hand) in HANDS.items():
        pushed = name.startswith("pushed")
        errors, ends = [], []
        for seed in range(SEED, SEED + size.seeds):
            needle = steer(new_hand(np.random.default_rng(seed)), seed, pushed=pushed)
            errors.append(rms_at_end(needle, _OFFSET) * 1e3)
            ends.append(needle.steering.state.value)
        rms, done = math.sqrt(float(np.mean(np.square(errors)))), ends.count("DONE")
        yield Finding(
            f"continuous_{name.split()[0].strip(',').replace('.', '_')}_{len(name)}",
            f"{name}: r1 over the last 20 mm, {size.seeds} needles",
            f"<= {bound:g} mm RMS, all at the depth",
            f"{rms:.3f} mm, worst {max(errors):.3f}; {done} of {size.seeds}",
            rms <= bound and done == size.seeds,
        )


def frame_rates(bench: Workbench, size: Size = FULL) -> Iterator[Finding]:
    """Study preset best at 5 mm/s beside stepwise; tips a second make no difference."""
    command = find_executable("needle_sim", "monte_carlo")
    figures = {}
    # 5 mm/s times 10, 33 and 100 ms; of tips between two uses nothing is taken but that they came.
    for delay in ("0", "0.05", "0.17", "0.5"):
        file = bench.folder / f"turn_delay_{delay}.json"
        options = ["--draws", str(size.draws), "--seed", str(SEED), "--turn-delay-mm", delay]
        ran([command, *options, "--json", str(file)])
        figures[delay] = json.loads(file.read_text("utf-8"))
    stepwise = figures.pop("0")["rms_last_20_mm"]
    for delay, seen in figures.items():
        rms, there = seen["rms_last_20_mm"], seen["converged_at_end"]
        yield Finding(
            f"continuous_turn_delay_{delay}",
            f"{seen['runs']} needles, turned {delay} mm after each used tip",
            f"RMS within 10 % of stepwise ({stepwise:.4f} mm), >= 99.95 % within 1 mm",
            f"{rms:.4f} mm, {there:.2%}",
            rms <= 1.1 * stepwise and there >= 0.9995,
        )


def same_run(bench: Workbench, size: Size = FULL) -> Iterator[Finding]:
    """Repeat whole continuous runs with their seed, at the levels with cameras and drives."""
    for level in size.levels:
        arguments = ("--insertion", "continuous", "--depth-mm", str(size.depth_mm))
        one, again = (
            bench.run(f"continuous_{level}_{n}", "--level", level, *arguments) for n in (1, 2)
        )
        first, second = (payloads(run.bag, _SAME_TOPICS) for run in (one, again))
        differ = [topic for topic in _SAME_TOPICS if first[topic] != second[topic]]
        counts = {topic: len(data) for topic, data in first.items()}
        yield Finding(
            f"continuous_same_run_{level}",
            f"level {level}, continuous, one seed twice",
            "tips, commands, answers and truth bit for bit",
            f"different: {', '.join(differ)}" if differ else f"same: {counts}",
            not differ and all(counts.values()),
        )
        rms = one.summary.get("r1_rms_last_20_mm")
        yield Finding(
            f"continuous_rms_{level}",
            f"level {level}: r1 over the last 20 mm",
            "<= 0.06 mm RMS",
            f"{rms} mm",
            isinstance(rms, float) and rms <= 0.06,
        )


CHECKS: tuple[Check, ...] = (hands, frame_rates, same_run)
