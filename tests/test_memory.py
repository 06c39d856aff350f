"""The model with memory: a known one is recovered, conserves energy and solves like any linear equation."""

import numpy as np
import pytest
import scipy.linalg
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.memory import fit_memory

B = 4
TIMES = torch.arange(0.0, 40.0, 0.25, dtype=torch.float64)


def known_model(seed=0):
    """A random transfer with one exponential and one damped pair, rows of Pi summing to 1 and of A_m to 0."""
    generator = np.random.default_rng(seed)
    basis = generator.dirichlet(np.ones(B), size=B)
    pair = generator.normal(size=(2, B, B)) * 0.1
    pair -= pair.mean(-1, keepdims=True)
    first = np.eye(B) - basis - pair[0]
    return tc.MemoryModel(
        rates=torch.zeros(B, B, dtype=torch.float64),
        basis=torch.from_numpy(basis),
        amplitudes=torch.from_numpy(np.stack([first, *pair])),
        decay=torch.tensor([0.4], dtype=torch.float64),
        pair_decay=torch.tensor([0.15], dtype=torch.float64),
        pair_frequency=torch.tensor([0.7], dtype=torch.float64),
    )


def transfer_of(model, noise=0.0, blocks=8):
    """An ensemble's record of the model's own transfer, with independent noise in every block."""
    scene = tc.Scene(n_particles=32, n_bands=B, times=TIMES, realizations=blocks)
    exact = model.transfer(TIMES).detach()
    generator = torch.Generator().manual_seed(3)
    shake = torch.randn(blocks, *exact.shape, generator=generator, dtype=torch.float64) * noise
    shake[:, :, 0] = 0
    shake -= shake.mean(-1, keepdim=True)
    block_mean = exact + shake
    long_time = model.basis.expand(blocks, B, B)
    stderr = block_mean.std(0) / blocks**0.5
    return BandTransfer(
        scene, TIMES, block_mean.mean(0), stderr, model.basis, torch.zeros(B, B, dtype=torch.float64), block_mean, long_time,
        (1,) * blocks, {"mass_mean": 1.0, "mass_sd": 0.3},
    )  # fmt: skip


def test_transfer_is_the_literal_sum():
    model = known_model()
    t = 3.7
    expected = (
        model.basis.numpy()
        + model.amplitudes[0].numpy() * np.exp(-0.4 * t)
        + np.exp(-0.15 * t)
        * (model.amplitudes[1].numpy() * np.cos(0.7 * t) + model.amplitudes[2].numpy() * np.sin(0.7 * t))
    )
    found = model.transfer(torch.tensor([t], dtype=torch.float64))[:, 0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-14)


def test_embedding_is_markovian():
    model = known_model()
    parts = model.embedding()
    for t in (0.0, 1.3, 20.0):
        flow = scipy.linalg.expm(parts.generator.numpy() * t)
        expected = parts.start.numpy() @ flow @ parts.readout.numpy()
        found = model.transfer(torch.tensor([t], dtype=torch.float64))[:, 0]
        np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-12)


def test_noise_free_model_is_recovered():
    model = known_model()
    tensors, report = fit_memory(TIMES, model.transfer(TIMES), model.basis, (1, 1))
    assert report.converged
    for name in ("decay", "pair_decay", "pair_frequency", "amplitudes"):
        torch.testing.assert_close(tensors[name], getattr(model, name), rtol=0, atol=1e-4)


def test_conservation_is_exact_and_the_artifact_keeps_everything(tmp_path):
    master = tc.calibrate(transfer_of(known_model(), noise=1e-3))
    assert master.calibration.model == "memory"
    assert master.model.conservation_defect < 1e-12
    master.save(tmp_path / "m.safetensors")
    again = tc.MasterEquation.load(tmp_path / "m.safetensors")
    start = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    late = [0.0, 1.0, 500.0]
    assert torch.equal(master.solve(start, late), again.solve(start, late))
    torch.testing.assert_close(again.solve(start, late).sum(-1), torch.ones(3, dtype=torch.float64), rtol=0, atol=1e-12)
    # every solver on the enlarged state; dopri5 within its own tolerance
    torch.testing.assert_close(
        again.solve(start, [0.0, 1.0, 30.0], method="dopri5"), again.solve(start, [0.0, 1.0, 30.0]), rtol=0, atol=1e-7
    )


def test_order_is_the_smallest_that_reaches_the_noise():
    master = tc.calibrate(transfer_of(known_model(), noise=1e-3))
    report = master.calibration.report
    assert report.fit.order == (1, 1)
    assert report.selection.held_out_distance <= 1.05 * report.selection.halves_distance


def test_infinite_time_is_the_basis():
    model = known_model()
    late = model.transfer(torch.tensor([1e4], dtype=torch.float64))[:, 0]
    torch.testing.assert_close(late, model.basis, rtol=0, atol=1e-14)


def test_refusals_name_field_and_rule():
    model = known_model()
    tensors = model.tensors()
    with pytest.raises(FieldError, match="amplitudes must add up to 1 - basis at time 0"):
        tc.MemoryModel(**{**tensors, "amplitudes": tensors["amplitudes"] * 1.1})
    with pytest.raises(FieldError, match="decay must not be negative"):
        tc.MemoryModel(**{**tensors, "decay": -tensors["decay"]})
    with pytest.raises(FieldError, match="order must have at most"):
        fit_memory(TIMES[:6], model.transfer(TIMES[:6]), model.basis, (3, 3))
    with pytest.raises(FieldError, match="model must be one of memory for method 'projection'"):
        tc.calibrate(transfer_of(model), method="projection", model="paper")
