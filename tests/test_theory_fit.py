"""Strength and damping recovered from rings that did not enter any measurement."""

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.theory import fit_disorder, theory_transfer

TIMES = torch.arange(0, 31, 3, dtype=torch.float64)
TONE, BAND = 22, 5


def curves(xi, seed, realizations=20, damping=0.0):
    chain = tc.Chain(tc.Disorder(strength=xi).masses(64, realizations, seed), damping=damping)
    state = tc.standing_wave(chain, TONE, 0.01)
    motion = tc.evolve(chain, state, TIMES, method="damped" if damping else "modes")
    energy = tc.band_energy(chain, motion, 8, normalize=False)
    return energy[..., BAND] / energy[:, :1].sum(-1)


@pytest.mark.parametrize("xi", [0.1, 0.3])
def test_strength_from_one_decay_curve(xi):
    fit = fit_disorder(TIMES, curves(xi, seed=11, realizations=80), 64, 8, tones=[TONE])
    assert 0 < fit.strength_stderr < 0.1 * xi
    assert abs(fit.strength - xi) < 3 * fit.strength_stderr


def test_strength_and_damping_together():
    fit = fit_disorder(TIMES, curves(0.2, 3, 60, damping=0.01), 64, 8, tones=[TONE], fit_damping=True)
    assert abs(fit.strength - 0.2) < 3 * fit.strength_stderr
    assert abs(fit.damping - 0.01) < 3 * fit.damping_stderr < 0.01


def test_a_transfer_of_its_own_is_recovered():
    exact = theory_transfer(tc.Disorder(strength=0.25), 32, 4, TIMES).mean
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(6, *exact.shape, generator=generator, dtype=torch.float64) * 1e-3
    fit = fit_disorder(TIMES, exact + noise - noise.mean(0), 32, 4)
    assert fit.strength == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize("shape", [(11,), (1, 11), (5, 10), (5, 8, 11, 7)])
def test_energies_of_another_shape_are_refused(shape):
    with pytest.raises(FieldError, match="energies must have shape"):
        fit_disorder(TIMES, torch.ones(shape), 64, 8, tones=[TONE])
