"""Training loop with losses, schedule and checkpoints."""

from __future__ import annotations

import copy
import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional
from tqdm import tqdm

from sample_pool import CONTEXT, Batch, Pool
from training_net import (
    LOG_INTENSITY,
    NEEDLE_WEIGHT,
    NeedleNet,
    export,
    load_weights,
    normalized_layer,
)

_BATCH, _DECAY = 16, 1e-4
_RATE, _TUNING_RATE = 3e-3, 3e-4  # maximum learning rate of a new net and of a trained one
_WARM_UP, _FIRST_RATE, _LAST_RATE = 0.08, 0.04, 0.002  # share of the run; shares of the rate
_END_WEIGHT = 0.04  # weight of the loss of ends relative to the loss of the shaft
_LARGEST_STEP = 2.0  # maximum norm of the gradients
_WORST, _MOST_BAD = (1.0, 30.0), 20  # losses above which a batch is skipped; consecutive skips
_FULL_PRECISION = 0.9  # progress after which bfloat16 is not used
_MEAN_OVER = 1000  # number of steps over which the weights are averaged
_POOL_UPDATE_PERIOD = 200  # steps between updates of the pool


@dataclasses.dataclass(frozen=True)
class Plan:
    """Length and files of a training run.

    Attributes
    ----------
    steps : int
        Number of steps of the whole run.
    minutes : float
        Maximum duration [min]; the learning rate decays accordingly.
    output, checkpoint : Path
        Files of the net and of the checkpoint.
    every : float
        Period of the checkpoints [s].
    """

    steps: int
    minutes: float
    output: Path
    checkpoint: Path
    every: float = 180.0


@dataclasses.dataclass
class Run:
    """Training that can be stored and resumed.

    Attributes
    ----------
    net, mean_net : NeedleNet
        The net, and its average over the last steps, which is exported.
    optimizer : AdamW
        Optimizer of the net.
    rng : Generator
        Generator for the choice of samples.
    rate : float
        Maximum learning rate.
    step : int
        Number of completed steps.
    seconds : float
        Total duration of the steps [s].
    """

    net: NeedleNet
    mean_net: NeedleNet
    optimizer: torch.optim.AdamW
    rng: np.random.Generator
    rate: float
    step: int = 0
    seconds: float = 0.0

    def state(self) -> dict[str, Any]:
        """Return the content of a checkpoint."""
        return {
            "net": self.net.state_dict(),
            "mean_net": self.mean_net.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "rng": self.rng.bit_generator.state,
            "torch_rng": torch.get_rng_state(),
            "rate": self.rate,
            "step": self.step,
            "seconds": self.seconds,
        }

    def save(self, path: Path) -> None:
        """Write a checkpoint, atomically."""
        new = path.with_suffix(".new")
        torch.save(self.state(), new)
        new.replace(path)


def new_run(seed: int, weights: Path | None = None) -> Run:
    """Return a new run.

    Parameters
    ----------
    seed : int
        Seed of the initial weights.
    weights : Path or None
        Initial weights, from `export`; None for an untrained net.
    """
    torch.manual_seed(seed)
    if weights is None:
        return _run(NeedleNet(normalized_layer), _RATE)
    net = NeedleNet()
    load_weights(net, weights)
    return _run(net, _TUNING_RATE)


def resumed(path: Path) -> Run:
    """Return the run in a checkpoint."""
    state = torch.load(path, weights_only=True)
    normalized = "middle.0.weight" in state["net"]
    run = _run(NeedleNet(normalized_layer) if normalized else NeedleNet(), state["rate"])
    run.net.load_state_dict(state["net"])
    run.mean_net.load_state_dict(state["mean_net"])
    run.optimizer.load_state_dict(state["optimizer"])
    run.rng.bit_generator.state = state["rng"]
    torch.set_rng_state(state["torch_rng"])
    run.step, run.seconds = state["step"], state["seconds"]
    return run


def _run(net: NeedleNet, rate: float) -> Run:
    net = net.to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(net.parameters(), rate, weight_decay=_DECAY)
    return Run(net, copy.deepcopy(net), optimizer, np.random.default_rng(0), rate)


def rate_share(progress: float) -> float:
    """Return the share of the maximum rate, which rises linearly, then falls as a cosine."""
    if progress < _WARM_UP:
        return _FIRST_RATE + (1.0 - _FIRST_RATE) * progress / _WARM_UP
    left = 0.5 * (1.0 + np.cos(np.pi * min((progress - _WARM_UP) / (1.0 - _WARM_UP), 1.0)))
    return float(_LAST_RATE + (1.0 - _LAST_RATE) * left)


def shaft_loss(logits: torch.Tensor, shares: torch.Tensor) -> torch.Tensor:
    """Return the mean loss of the shaft probability, with a higher weight for needle pixels."""
    losses = functional.binary_cross_entropy_with_logits(logits, shares, reduction="none")
    return (losses * (1.0 + NEEDLE_WEIGHT * shares)).mean()


def end_loss(log_intensity: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return the negative log-likelihood of the ends, averaged over patches.

    Ends are a Poisson process of intensity lambda: -log L = sum(lambda) - sum_ends log(lambda).
    Likelihood is a proper score, so the net learns peaks whose spread is their error and whose sum
    is the probability of an end.

    Parameters
    ----------
    log_intensity : Tensor, shape (n, height, width)
        log(lambda) [1/px^2].
    ends : Tensor, shape (n, 2)
        Column and row of the end in each patch [px]; NaN if there is none.
    """
    # Keep the gradient of clamped values, so that they can return to the range.
    cut = log_intensity + (log_intensity.clamp(*LOG_INTENSITY) - log_intensity).detach()
    intensity = torch.exp(cut)
    total = intensity.sum()
    which = torch.isfinite(ends).all(dim=1).nonzero()[:, 0]
    x, y = ends[which].unbind(dim=1)
    height, width = intensity.shape[1:]
    column = x.floor().long().clamp(0, width - 2)
    row = y.floor().long().clamp(0, height - 2)
    right, down = x - column, y - row
    at_end = (1 - down) * (
        (1 - right) * intensity[which, row, column] + right * intensity[which, row, column + 1]
    ) + down * (
        (1 - right) * intensity[which, row + 1, column]
        + right * intensity[which, row + 1, column + 1]
    )
    return (total - torch.log(at_end).sum()) / len(ends)


def losses(net: NeedleNet, batch: Batch, *, rounded: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the losses of shaft and ends, if `rounded` with bfloat16, which may be faster."""
    inputs = torch.from_numpy(batch.inputs).to(memory_format=torch.channels_last)
    with torch.autocast("cpu", torch.bfloat16, enabled=rounded):
        out = net(inputs)
    out = out.float()[:, :, CONTEXT:-CONTEXT, CONTEXT:-CONTEXT]
    return (
        shaft_loss(out[:, 0], torch.from_numpy(batch.shares)),
        end_loss(out[:, 1], torch.from_numpy(batch.ends)),
    )


def rounds_quickly() -> bool:
    """Return whether bfloat16 is faster on this processor."""
    cpu = Path("/proc/cpuinfo")
    return cpu.exists() and "amx_bf16" in cpu.read_text(encoding="utf-8")


def train(run: Run, pool: Pool, plan: Plan) -> None:
    """Train to the end of the plan, with periodic checkpoints.

    Parameters
    ----------
    run : Run
        New or resumed run.
    pool : Pool
        Training samples.
    plan : Plan
        Length and files of the run.

    Raises
    ------
    RuntimeError
        If the net diverges; the run can be resumed from the last checkpoint.
    """
    # More threads would be slower for such a small net.
    torch.set_num_threads(1)
    quick = rounds_quickly()
    began = saved = time.monotonic()
    before = run.seconds
    means = np.zeros(2)
    bad = 0
    bar = tqdm(total=plan.steps, initial=run.step, desc="training", unit="step", mininterval=10.0)
    pool.update()
    while (progress := max(run.step / plan.steps, run.seconds / (60.0 * plan.minutes))) < 1.0:
        if run.step % _POOL_UPDATE_PERIOD == 0:
            pool.update()
        for group in run.optimizer.param_groups:
            group["lr"] = run.rate * rate_share(progress)
        batch = pool.batch(run.rng, _BATCH)
        shaft, end = losses(run.net, batch, rounded=quick and progress < _FULL_PRECISION)
        if not (shaft.item() < _WORST[0] and end.item() < _WORST[1]):
            bad += 1
            if bad >= _MOST_BAD:
                raise RuntimeError(f"diverged at step {run.step}: resume from {plan.checkpoint}")
            continue
        bad = 0
        run.optimizer.zero_grad()
        (shaft + _END_WEIGHT * end).backward()
        torch.nn.utils.clip_grad_norm_(run.net.parameters(), _LARGEST_STEP)
        run.optimizer.step()
        run.step += 1
        with torch.no_grad():
            share = 1.0 / min(run.step / 10.0 + 1.0, _MEAN_OVER)
            means_and_news = zip(
                run.mean_net.state_dict().values(), run.net.state_dict().values(), strict=True
            )
            for mean, new in means_and_news:
                if mean.is_floating_point():
                    mean.lerp_(new, share)
        now = time.monotonic()
        run.seconds = before + now - began
        means += (np.array([shaft.item(), end.item()]) - means) / min(run.step, 200)
        bar.update()
        bar.set_postfix(shaft=f"{means[0]:.4f}", end=f"{means[1]:.3f}", refresh=False)
        if now - saved > plan.every:
            saved = now
            store(run, plan.output, plan.checkpoint)
    bar.close()
    store(run, plan.output, plan.checkpoint)


def store(run: Run, output: Path, checkpoint: Path) -> None:
    """Write the net and the checkpoint."""
    export(run.mean_net, output)
    run.save(checkpoint)
