"""Certificates: bounds for the whole time axis, models they refuse, and the fit that passes them."""

import math

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.master import nonnegative as nonnegative_fit
from torchchain.master.certificate import (
    Certificate,
    CertificateError,
    Exponentials,
    certify,
    verify,
)
from torchchain.master.fits import FitWarning
from torchchain.master.memory import MemoryModel
from torchchain.master.nonnegative import nonnegative

EYE = torch.eye(2, dtype=torch.float64)


def memory(basis, amplitudes, decay=(), pair_decay=(), pair_frequency=()):
    arrays = [
        torch.as_tensor(part, dtype=torch.float64) for part in (basis, amplitudes, decay, pair_decay, pair_frequency)
    ]
    return MemoryModel(torch.zeros_like(arrays[0]), *arrays)


def oscillating(depth, decay=0.01, frequency=1.0, level=0.5):
    """T[0, 1](t) = level - (level - depth') exp(-g t) cos(w t) ...: its value at 0 is 0 and it dips towards ``depth``."""
    basis = torch.tensor([[1 - level, level], [level, 1 - level]], dtype=torch.float64)
    cosine = EYE - basis
    sine = depth * torch.tensor([[-1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
    return memory(basis, torch.stack([cosine, sine]), (), (decay,), (frequency,))


def dense(model, end=2000.0):
    times = torch.cat([torch.linspace(0, 60, 60001), torch.linspace(60, end, 40001)[1:]]).double()
    return model.transfer(times)


@pytest.mark.parametrize("depth", [0.0, 0.003, 0.2, -0.4])
@pytest.mark.parametrize("decay", [0.01, 0.2])
def test_bounds_enclose_every_value_and_come_close(depth, decay):
    model = oscillating(depth, decay)
    certificate, values = certify(model), dense(model)
    assert certificate.lower <= float(values.min()) + 1e-13
    assert certificate.upper >= float(values.max()) - 1e-13
    assert certificate.conservation_defect < 1e-14
    assert certificate.holds == (float(values.min()) >= -1e-12)


def test_a_dip_between_sampled_times_is_found():
    """Energies that are negative for a ten-thousandth of the time axis, to a millionth."""
    rate = 50.0
    model = oscillating(0.0, decay=1e-6, frequency=rate)
    assert certify(model).lower >= -1e-12  # touches zero at every period, and is proved not to cross
    worse = oscillating(1e-3, decay=1e-6, frequency=rate)  # crosses by 2.5e-7 |sin| just before each
    found = certify(worse)
    assert not found.holds
    assert float(dense(worse, 61.0).min()) >= 0  # a grid of 1e-3 steps over it
    near = 2 * math.pi / rate - torch.linspace(0, 1e-4, 1001, dtype=torch.float64)
    assert found.lower <= float(worse.transfer(near).min()) < -1e-7


def test_undamped_negative_energies_are_refused():
    never = oscillating(0.3, decay=0.0)
    certificate = certify(never)
    assert not certificate.holds
    assert certificate.tail == math.inf
    assert certificate.lower <= float(dense(never).min())


def test_late_negative_energies_are_found():
    """Pi is positive and so is all up to t = 100, but a slow function turns negative at t = 1000."""
    basis = torch.full((2, 2), 0.5, dtype=torch.float64)
    ones = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
    slow = 0.6 * ones  # T[0, 1] = 0.5 + 0.6 (-e^{-t/1000}) ... + 0.1 e^{-t/10}
    model = memory(basis, torch.stack([slow, (EYE - basis) - slow]), (1e-3, 0.1))
    assert float(model.transfer(torch.tensor([100.0], dtype=torch.float64)).min()) < 0
    certificate = certify(model)
    assert not certificate.holds


def test_rates_are_certified_by_their_eigenvalues():
    good = tc.RateModel(torch.tensor([[-0.3, 0.3], [0.1, -0.1]], dtype=torch.float64), torch.zeros(2))
    bad = tc.RateModel(torch.tensor([[0.3, -0.3], [-0.1, 0.1]], dtype=torch.float64), torch.zeros(2))
    negative = tc.RateModel(
        torch.tensor([[-0.3, 0.4, -0.1], [0.2, -0.4, 0.2], [0.1, 0.1, -0.2]], dtype=torch.float64), torch.zeros(3)
    )
    assert certify(good).holds
    assert certify(bad).lower == -math.inf  # grows
    assert not certify(negative).holds


def test_nonnegative_keeps_a_good_model_and_mends_a_bad_one(small_transfer):
    free = tc.calibrate(small_transfer, "projection", order=(2, 3), bootstrap=0).model
    noise = tc.statistical_distance(small_transfer.stderr).mean(0)
    times, mean = small_transfer.times, small_transfer.mean
    model, certificate = nonnegative(free, times, mean, noise)
    assert certificate == certify(model)
    assert certificate.holds
    assert certificate.conservation_defect < 1e-12
    later = torch.cat([torch.logspace(-4, 6, 4000).double(), torch.linspace(0, 50, 4000).double()[1:]]).sort().values
    values = model.transfer(later)
    assert float(values.min()) >= -1e-12
    assert float((values.sum(-1) - 1).abs().max()) < 1e-12
    off, before = (float(tc.total_variation(part.transfer(times), mean)[:, 1:].mean()) for part in (model, free))
    assert off < 1.05 * before + 0.1 * float(noise[1:].mean())
    again, _ = nonnegative(model, times, mean, noise)  # has the early functions twice; nothing to mend
    assert float((again.transfer(times) - model.transfer(times)).abs().max()) < 0.2 * float(noise.max())
    verify(model, certificate)


def test_the_nearest_of_several_sets_of_functions_is_taken(small_transfer, monkeypatch):
    with pytest.warns(FitWarning):
        free = tc.calibrate(small_transfer, "projection", order=(2, 3), bootstrap=0).model
    noise = tc.statistical_distance(small_transfer.stderr).mean(0)
    times, mean = small_transfer.times, small_transfer.mean
    weight = 1 / noise.clamp(min=1e-5 * float(noise.max()))[1:]

    def off(cuts):
        monkeypatch.setattr(nonnegative_fit, "CUTS", cuts)
        model, certificate = nonnegative(free, times, mean, noise)
        assert certificate.holds
        return float(((model.transfer(times) - mean)[:, 1:] * weight[:, None]).square().sum().sqrt())

    every = nonnegative_fit.CUTS
    alone = [off((cut,)) for cut in every]
    assert off(every) <= nonnegative_fit.NEARLY * min(alone)
    monkeypatch.setattr(nonnegative_fit, "NEARLY", 0.0)  # none will do at once: all are tried
    assert off(every) <= 1.001 * min(alone)  # beside the times there are some beyond, which count a little


def test_onset_is_the_fourth_power_of_time(small_transfer):
    model, _ = nonnegative(
        tc.calibrate(small_transfer, "projection", order=(2, 3), bootstrap=0).model, small_transfer.times, small_transfer.mean
    )  # fmt: skip
    times = torch.tensor([0.01, 0.02], dtype=torch.float64)
    lost = 1 - model.transfer(times).diagonal(dim1=0, dim2=2).T
    strong = lost[:, 0] > 1e-12  # above rounding
    assert bool(strong.any())
    power = (lost[strong, 1] / lost[strong, 0]).log2()
    assert bool(((power > 3.5) & (power < 4.5)).all())  # the fourth is the nearest power


def test_bounds_of_random_sums_agree_with_fine_grids():
    generator = np.random.default_rng(2)
    basis = generator.dirichlet(np.ones(4), 4)
    for _ in range(5):
        amplitudes = 0.05 * generator.normal(size=(4, 4, 4))
        amplitudes -= amplitudes.mean(-1, keepdims=True)
        amplitudes[0] = np.eye(4) - basis - amplitudes[1] - amplitudes[2]
        model = memory(basis, amplitudes, (0.4, 1.2), (0.3,), (0.9,))
        certificate, values = certify(model), dense(model, 100.0)
        lowest = float(values.min())
        assert certificate.lower <= lowest + 1e-13
        if lowest < -1e-6:
            assert not certificate.holds


def test_a_model_other_than_its_certificate_is_refused():
    good, bad = oscillating(0.0), oscillating(0.3)
    verify(good, certify(good))
    with pytest.raises(CertificateError, match="certificate must hold for its model: lower"):
        verify(bad, certify(good))


def test_records():
    certificate = certify(oscillating(0.0, decay=0.2))
    record = certificate.to_dict()
    assert Certificate.from_dict(record) == certificate
    record["drift"] = record.pop("conservation_defect")  # as files had it before
    assert Certificate.from_dict(record) == certificate
    endless = Certificate(-1e-15, 1.0, math.inf, 3.0, 7)
    assert Certificate.from_dict(endless.to_dict()) == endless
    with pytest.raises(FieldError, match="certificate must have only the keys"):
        Certificate.from_dict({**certificate.to_dict(), "more": 1})
    with pytest.raises((FieldError, FieldTypeError), match="certificate.lower must"):
        Certificate.from_dict({**certificate.to_dict(), "lower": "x"})


def test_taylor_coefficients_are_those_of_the_transfer():
    model = oscillating(0.1, 0.05, 1.3)
    parts = Exponentials.of(model)
    powers = 0.7 ** np.arange(17)
    (found,) = (parts.taylor(np.array([2.0]), np.array([1.0])) @ powers).T
    expected = model.transfer(torch.tensor([2.7], dtype=torch.float64))[:, 0].flatten().numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
