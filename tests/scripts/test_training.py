"""Training of the needle net: its input, its progress, and its resumption."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from code_lines import ROOT
from needle_bringup.training.samples import BORDER, CANVAS, SIZE, Sample
from needle_bringup.training.traced_scenes import TracedScene
from needle_tracker.detector.needle_net import normalized
from net_report import end_error, peaks, report
from sample_pool import CONTEXT, SHARD, Pool, batch_of, read_shard, write_shard

TRAINING = "only scripts/train_needle_map installs torch and onnx"
WEIGHTS = ROOT / "ros2_ws/src/needle_tracker/needle_tracker/detector/needle_net.onnx"
END = np.array([60.0, 90.0])
_COUNT = 16


def flat_sample(rng: np.random.Generator) -> Sample:
    """Return a bright bar that ends at END, on grain; every other one with a background."""
    share = np.zeros((CANVAS, CANVAS), np.uint8)
    share[88:93, :61] = 255
    grain = rng.normal(60.0, 3.0, share.shape)
    image = np.clip(grain + 0.5 * share, 0, 255).astype(np.uint8)
    background = np.clip(grain, 0, 255).astype(np.uint8) if rng.random() < 0.5 else None
    return Sample(image, background, share, END.copy())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("samples")
    write_shard(where / "drawn-00000.npz", [0, 0], flat_sample)
    write_shard(where / "traced-00000.npz", [1, 0], flat_sample)
    return where


def test_a_flat_image_is_level_and_an_edge_is_not() -> None:
    # Running sums of such an image end slightly below zero.
    for level in range(0, 256, 5):
        assert np.abs(normalized(np.full((120, 90), level, np.uint8))).max() < 0.01
    image = np.full((100, 100), 50, np.uint8)
    image[:, 50:] = 150
    inputs = normalized(image)
    assert inputs[50, 45] < -0.5
    assert inputs[50, 55] > 0.5
    assert np.abs(inputs).max() <= 4.0


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("mirror", [False, True])
def test_ends_are_turned_with_their_images(folder: Path, turn: int, mirror: bool) -> None:
    batch = batch_of([(read_shard(folder / "drawn-00000.npz"), 0)], [turn], [mirror])
    x, y = batch.ends[0]
    rows, columns = np.nonzero(batch.shares[0] > 0.5)
    away = np.hypot(columns - x, rows - y)
    # The bar ends there, in its middle, and nowhere else.
    assert away.min() == 0.0
    assert (away < 4.0).sum() < 0.6 * math.pi * 4.0**2
    inputs = batch.inputs[0, 0, CONTEXT:-CONTEXT, CONTEXT:-CONTEXT]
    assert inputs[batch.shares[0] > 0.5].mean() > inputs[batch.shares[0] < 0.5].mean() + 1.0


def test_a_background_that_is_not_known_is_zero(folder: Path) -> None:
    shard = read_shard(folder / "drawn-00000.npz")
    batch = batch_of([(shard, i) for i in range(_COUNT)], [0] * _COUNT, [False] * _COUNT)
    side = SIZE + 2 * CONTEXT
    assert batch.inputs.shape == (_COUNT, 2, side, side)
    known = shard.known[:_COUNT]
    assert 0 < known.sum() < _COUNT
    np.testing.assert_array_equal(batch.inputs[:, 1].any(axis=(1, 2)), known)


def test_an_end_outside_the_patch_is_none(tmp_path: Path) -> None:
    def outside(rng: np.random.Generator) -> Sample:
        sample = flat_sample(rng)
        sample.end[:] = BORDER - 2.0, 90.0
        return sample

    write_shard(tmp_path / "drawn-00000.npz", [0], outside)
    batch = batch_of([(read_shard(tmp_path / "drawn-00000.npz"), 0)], [0], [False])
    assert np.isnan(batch.ends).all()


def test_a_pool_adds_new_files_and_drops_removed_ones(folder: Path, tmp_path: Path) -> None:
    pool = Pool(tmp_path)
    assert pool.update() == 0
    for name in ("drawn-00000.npz", "traced-00000.npz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "traced-00001.new").write_bytes(b"half of it")
    assert pool.update() == 2 * SHARD
    assert len(pool.batch(np.random.default_rng(0), 10).inputs) == 10
    (tmp_path / "traced-00000.npz").unlink()
    assert pool.update() == SHARD


def torch_and_loop() -> tuple[Any, Any]:
    torch = pytest.importorskip("torch", reason=TRAINING)
    pytest.importorskip("onnx", reason=TRAINING)
    return torch, pytest.importorskip("training_loop")


def test_the_loss_of_ends_is_least_at_the_true_intensity() -> None:
    torch, loop = torch_and_loop()
    rows, columns = np.indices((40, 40))
    spread, chance = 1.5, 0.7
    errors = np.random.default_rng(0).normal(0.0, spread, (600, 2)) + 20.0
    errors[int(chance * len(errors)) :] = np.nan
    ends = torch.from_numpy(errors.astype(np.float32))

    def loss(sigma: float, total: float) -> float:
        peak = np.exp(-((rows - 20.0) ** 2 + (columns - 20.0) ** 2) / (2 * sigma**2))
        peak = np.log(total * peak / peak.sum() + 1e-6)
        tiled = np.repeat(peak[None].astype(np.float32), len(errors), 0)
        return float(loop.end_loss(torch.from_numpy(tiled), ends))

    least = loss(spread, chance)
    for sigma, total in ((1.0, chance), (2.2, chance), (spread, 0.5), (spread, 1.0)):
        assert loss(sigma, total) > least


def test_an_intensity_that_was_cut_off_returns() -> None:
    torch, loop = torch_and_loop()
    low = torch.full((1, 20, 20), -30.0, requires_grad=True)
    loop.end_loss(low, torch.tensor([[10.5, 9.5]])).backward()
    assert float(low.grad[0, 9, 10]) == pytest.approx(-0.25, rel=0.01)


def test_the_rate_rises_then_falls_to_nearly_nothing() -> None:
    _, loop = torch_and_loop()
    rates = [loop.rate_share(progress) for progress in np.linspace(0.0, 1.0, 101)]
    assert max(rates) == pytest.approx(loop.rate_share(0.08))
    assert np.all(np.diff(rates[8:]) <= 0.0)
    assert rates[-1] < 0.01 * max(rates)


def test_a_net_that_diverges_ends_the_run_and_is_not_stored(folder: Path, tmp_path: Path) -> None:
    torch, loop = torch_and_loop()
    run = loop.new_run(0)
    with torch.no_grad():
        run.net.out.weight.mul_(1e6)
    with pytest.raises(RuntimeError, match="diverged at step 0: resume from"):
        loop.train(run, Pool(folder), loop.Plan(40, 5.0, tmp_path / "n.onnx", tmp_path / "c.pt"))
    assert not list(tmp_path.iterdir())


def test_a_run_is_resumed_exactly_and_opencv_reads_its_net(folder: Path, tmp_path: Path) -> None:
    torch, loop = torch_and_loop()
    pool = Pool(folder)
    paths = tmp_path / "needle_net.onnx", tmp_path / "checkpoint.pt"
    run = loop.new_run(3)
    with warnings.catch_warnings():
        # The exporter warns of a newer version.
        warnings.simplefilter("ignore")
        loop.train(run, pool, loop.Plan(4, 5.0, *paths))
    other = loop.resumed(paths[1])
    assert other.step == run.step
    assert other.rng.bit_generator.state == run.rng.bit_generator.state
    for one, same in zip(run.net.parameters(), other.net.parameters(), strict=True):
        assert torch.equal(one, same)
    # It continues with its own samples, and not beyond its end.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loop.train(other, Pool(folder), loop.Plan(6, 5.0, tmp_path / "other.onnx", paths[1]))
        loop.train(other, Pool(folder), loop.Plan(6, 5.0, tmp_path / "other.onnx", paths[1]))
    assert run.step == 4
    assert other.step == 6
    # Any multiples of 4: the stored net has no fixed size.
    inputs = np.random.default_rng(0).normal(0.0, 1.0, (1, 2, 100, 148)).astype(np.float32)
    with torch.no_grad():
        net = pytest.importorskip("training_net")
        expected = net.StoredNet(run.mean_net).eval()(torch.from_numpy(inputs))
    stored = cv2.dnn.readNetFromONNX(str(paths[0]))
    stored.setInput(inputs)
    for got, want in zip(stored.forward(["shaft", "end"]), expected, strict=True):
        np.testing.assert_allclose(got, want.numpy(), atol=1e-4)
    assert 0.0 < float(expected[0].min()) < float(expected[0].max()) < 1.0


def test_a_net_from_stored_weights_equals_the_stored_net(tmp_path: Path) -> None:
    torch, loop = torch_and_loop()
    net = pytest.importorskip("training_net")
    path = tmp_path / "needle_net.onnx"
    inputs = torch.from_numpy(np.random.default_rng(0).normal(0.0, 1.0, (2, 2, 64, 64)))
    run = loop.new_run(5)
    run.net(inputs.float())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        net.export(run.net, path)
    tuned = loop.new_run(0, path)
    with torch.no_grad():
        one, other = (each.net.eval()(inputs.float()) for each in (run, tuned))
    np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-4)
    assert tuned.rate < run.rate


def test_a_peak_is_judged_along_and_across_the_shaft() -> None:
    rows, columns = np.indices((80, 80))
    share = ((np.abs(rows - 40) < 3) & (columns < 50)).astype(float)
    end = np.array([49.5, 40.0])
    peak = np.exp(-0.5 * (((columns - 51.2) / 2.0) ** 2 + ((rows - 40.0) / 0.5) ** 2))
    intensity = 0.9 * peak / peak.sum()
    error = end_error(intensity, share, end)
    assert error is not None
    assert error.along == pytest.approx(1.7, abs=0.15)
    assert error.across == pytest.approx(0.0, abs=0.05)
    assert error.sigmas == pytest.approx(0.85, rel=0.2)
    np.testing.assert_array_equal(peaks(intensity + 1e-9), [[51, 40]])
    assert end_error(0.3 * intensity, share, end) is None
    assert not len(peaks(0.3 * intensity))


def test_the_report_counts_ends_and_false_ends_by_width_and_background() -> None:
    share = np.zeros((160, 240), np.uint8)
    share[77:82, :121] = 255
    floor = np.full(share.shape, 120, np.uint8)
    images = np.stack([floor, floor, np.where(share, 30, floor).astype(np.uint8), floor])
    shares = np.stack([0 * share, 0 * share, share, share])
    ends = np.array([[np.nan, np.nan], [np.nan, np.nan], [120.5, 79.0], [np.nan, np.nan]])
    scene = TracedScene(images, shares, ends, np.full(4, 5.0))
    head, *rows = report(WEIGHTS.read_bytes(), [scene]).splitlines()
    assert [line.split()[:5] for line in rows] == [
        ["4", "to", "6", known, "1"] for known in ("no", "yes")
    ]
    for line in rows:
        assert len(line) == len(head)
        (*_, seen, along, across, _, others, empty, false) = line.split()
        assert (seen, others, empty, false) == ("100.0%", "0.00", "2", "0.00")
        assert float(along) < 3.0
        assert float(across) < 1.0
