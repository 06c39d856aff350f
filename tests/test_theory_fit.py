"""Strength and damping recovered from rings that did not enter any measurement."""

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.theory import effective_medium, fit_disorder, theory_transfer, transfer_at

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


def test_transfer_has_derivatives_in_strength_and_damping():
    strength, damping = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.2, 0.01))
    share = transfer_at(strength, 32, 4, [2.0, 4.0], damping, kind="binary")[2]
    weight = torch.tensor([[0.0, 1.0, 2.0, -1.0], [1.0, 0.0, 1.0, 3.0]], dtype=torch.float64)
    (weight * share.square()).sum().backward()

    def loss(xi, rate):
        result = theory_transfer(tc.Disorder("binary", xi), 32, 4, [2.0, 4.0], damping=rate)
        return float((weight * result.mean[2].square()).sum())

    # Richardson's fourth-order differences at other steps
    for found, function in (
        (strength.grad, lambda h: loss(0.2 + h, 0.01)),
        (damping.grad, lambda h: loss(0.2, 0.01 + h)),
    ):
        wide, narrow = ((function(h) - function(-h)) / (2 * h) for h in (0.004, 0.002))
        assert float(found) == pytest.approx((4 * narrow - wide) / 3, rel=2e-4)


@pytest.mark.parametrize("kind", ["normal", "uniform", "binary", "lognormal", "gamma"])
def test_the_medium_is_differentiable_in_the_strength(kind):
    def masses(strength):
        found = effective_medium(tc.Disorder(kind), [0.5, 1.0, 1.6], broadening=0.1, strength=strength)
        return torch.view_as_real(torch.stack([found.mass, found.resolvent]))

    strength = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(masses, (strength,), eps=1e-5, atol=1e-6, rtol=1e-4)


def test_derivative_of_the_transfer_at_no_disorder_is_zero():
    strength = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    transfer_at(strength, 16, 2, [3.0])[1, 0, 1].backward()
    assert float(strength.grad) == 0


def test_newton_steps_with_the_derivative_find_the_strength():
    exact = theory_transfer(tc.Disorder(strength=0.25), 32, 4, [2.0, 4.0]).mean
    strength = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    for _ in range(3):
        share = transfer_at(strength, 32, 4, [2.0, 4.0])[2, :, 2]
        slope = torch.autograd.grad(share.sum(), strength)[0]
        with torch.no_grad():
            strength += (exact[2, :, 2] - share).sum() / slope
    assert float(strength.detach()) == pytest.approx(0.25, rel=1e-5)


def test_derivatives_want_scalars():
    with pytest.raises(FieldError, match="strength must be a scalar"):
        transfer_at(torch.ones(2), 32, 4, [1.0])
