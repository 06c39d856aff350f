"""Transfers from runs whose starts are spread over several bands."""

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.ensemble.mixed_starts import fit_transfer

B, T = 4, 6


def known_transfer():
    generator = torch.Generator().manual_seed(0)
    return torch.softmax(torch.randn(B, T, B, dtype=torch.float64, generator=generator), -1)


def test_a_known_transfer_is_recovered():
    generator = torch.Generator().manual_seed(1)
    starts = torch.rand(30, B, dtype=torch.float64, generator=generator)
    energies = torch.einsum("ns,str->ntr", starts, known_transfer())
    found = fit_transfer(starts, energies, torch.arange(30))
    assert float((found.mean - known_transfer()).abs().max()) < 1e-12
    assert float(found.stderr.max()) < 1e-12
    assert float((found.block_mean.mean(0) - found.mean).abs().max()) < 1e-10
    assert sum(found.block_counts) == 30


def test_standard_errors_hold():
    """The error over many repetitions is what one of them says."""
    generator = torch.Generator().manual_seed(2)
    starts = torch.rand(80, B, dtype=torch.float64, generator=generator)
    clean = torch.einsum("ns,str->ntr", starts, known_transfer())
    means, errors = [], []
    for _ in range(40):
        noise = 0.05 * torch.randn(clean.shape, dtype=torch.float64, generator=generator)
        found = fit_transfer(starts, clean + noise, torch.arange(80))
        means.append(found.mean)
        errors.append(found.stderr)
    ratio = torch.stack(errors).square().mean().sqrt() / torch.stack(means).std(0).square().mean().sqrt()
    assert 0.8 < float(ratio) < 1.25


def test_pure_starts_give_the_mean_of_each_source():
    generator = torch.Generator().manual_seed(3)
    energies = torch.rand(12, T, B, dtype=torch.float64, generator=generator)
    source = torch.arange(12) % B
    found = fit_transfer(torch.eye(B, dtype=torch.float64)[source], energies, torch.arange(12) // B)
    expected = torch.stack([energies[source == s].mean(0) for s in range(B)])
    assert float((found.mean - expected).abs().max()) < 1e-12


def test_random_starts_of_chains_agree_with_standing_waves():
    """Random superpositions of tones see the transfer that single tones see, within both errors."""
    scene = tc.Scene(n_particles=64, n_bands=4, realizations=200, times=torch.arange(0.0, 11.0, 2.0), seed=5)
    tones = torch.arange(1, 32)
    chain = scene.chain(range(200))
    generator = torch.Generator().manual_seed(4)
    waves = tc.standing_wave(chain, tones.tolist(), amplitude=1e-3).displacement
    weights = torch.randn(200, len(tones), dtype=torch.float64, generator=generator) / tones
    weights = weights * torch.exp(torch.randn(200, 4, dtype=torch.float64, generator=generator))[:, (tones - 1) // 8]
    start = tc.State((weights[:, :, None] * waves).sum(1), torch.zeros_like(chain.masses))
    energies = tc.band_energy(chain, tc.evolve(chain, start, scene.times), 4)
    found = fit_transfer(energies[:, 0], energies, torch.arange(200))
    assert found.condition < 20
    late = fit_transfer(energies[:, 0], energies, torch.arange(200)).mean.sum(-1)
    assert float((late - 1).abs().max()) < 1e-9


def test_hopeless_starts_are_refused():
    energies = torch.rand(9, T, B, dtype=torch.float64)
    quiet = torch.rand(9, B, dtype=torch.float64)
    quiet[:, 2] = 0
    with pytest.raises(FieldError, match="starts must excite every band in some run, got none in band 3"):
        fit_transfer(quiet, energies, torch.arange(9))
    same = torch.ones(9, B, dtype=torch.float64)
    with pytest.raises(FieldError, match="starts must tell the 4 bands apart"):
        fit_transfer(same, energies, torch.arange(9))
    with pytest.raises(FieldError, match="energies must have shape"):
        fit_transfer(same, energies[..., :3], torch.arange(9))
