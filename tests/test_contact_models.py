"""Which contacts a scene needs: the ladder beside Hertz chains, in the plan, and at its edges."""

import math

import pytest
import torch

import torchchain as tc
from torchchain import mixing
from torchchain.ensemble.contact_models import OPENING, contact_models, linear_error, quadratic_error


def scene(amplitude, **changes):
    wave = tc.StandingWave(tones=(20,), amplitude=amplitude)
    given = {"contact": "hertz", "observables": ("total_energy",), "times": [0.0, 200.0]} | changes
    return tc.Scene(n_particles=64, n_bands=8, excitation=wave, realizations=4, **given)


def test_the_plan_climbs_with_the_amplitude():
    enough = [
        [model.enough for model in tc.plan(scene(amplitude, tolerance=0.02)).contact_models]
        for amplitude in (0.003, 0.06, 0.5)
    ]
    assert enough == [[True, True, True], [False, True, True], [False, False, True]]
    words = "\n".join(tc.plan(scene(0.06, tolerance=0.02)).reasons)
    assert "linear plus quadratic contacts are enough here" in words
    asked = tc.plan(scene(0.06, tolerance=0.02, contact="linear")).reasons
    assert any("between frequencies" in reason for reason in asked)
    assert not any("between frequencies" in reason for reason in tc.plan(scene(0.003, contact="linear")).reasons)


def test_an_elongation_is_the_root_of_the_energy_per_particle():
    """A^2 sin^2(k / 2) of a standing wave in the ordered chain."""
    model = tc.plan(scene(0.05, tolerance=0.02, disorder=tc.Disorder(strength=0.0))).contact_models[0]
    elongation = 0.05 * math.sin(math.pi * 20 / 64)
    assert model.error == pytest.approx(linear_error(elongation, 200.0), rel=1e-6)


@pytest.mark.parametrize("tolerance", [0.003, 0.03, 0.2])
def test_an_edge_is_where_the_error_is_the_tolerance(tolerance):
    linear, quadratic, hertz = contact_models(0.1, 150.0, tolerance)
    assert linear_error(linear.edge, 150.0) == pytest.approx(tolerance, rel=1e-6)
    assert quadratic.edge == OPENING or quadratic_error(quadratic.edge, 150.0) == pytest.approx(tolerance, rel=1e-6)
    assert linear.edge < quadratic.edge < hertz.edge


def test_what_linear_contacts_miss_on_hertz_chains():
    """A start in two of twelve bands, a fresh ensemble: as predicted within a factor of two."""
    chains = tc.Scene(n_particles=64, boundary="fixed", n_bands=1, realizations=12, seed=3)
    bands = mixing.FrequencyBands.covering(chains.chain(range(8)))
    share = torch.zeros(1, 12, dtype=torch.float64)
    share[0, 3], share[0, 5] = 0.5, 0.5
    for elongation in (0.08, 0.15):
        data = mixing.measure_mixing(chains, elongation, bands, starts=share, times=[0.0, 60.0, 200.0])
        energy = data.mean[0] / elongation**2
        missed = 0.5 * (energy[1:] - energy[0]).abs().sum(-1)
        for found, end in zip(missed.tolist(), (60.0, 200.0), strict=True):
            assert 0.5 < found / linear_error(elongation, end) < 2


def test_kicks_and_damped_chains_have_no_ladder():
    kick = tc.Scene(
        n_particles=64, excitation=tc.Impulse(), contact="hertz", observables=("total_energy",), times=[0.0, 9.0]
    )
    assert tc.plan(kick).contact_models == tc.plan(scene(0.05, damping=0.05)).contact_models == ()
    with pytest.raises(tc.FieldError, match="tolerance must be"):
        contact_models(0.1, 1.0, 0.0)
