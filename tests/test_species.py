"""Mixtures of species against the diatomic chain in closed form, and what must hold of their energies."""

import math

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.species import (
    Mixture,
    Species,
    damped_modes,
    diatomic_frequencies,
    species_band_energy,
    species_energy,
)

PAIR = (Species("soft", mass=0.8, stiffness=0.3, damping=0.1), Species("stiff", mass=1.2, stiffness=1.5))


def test_alternating_ring_is_the_diatomic_chain():
    mixture = Mixture((Species("light", mass=0.5), Species("heavy", mass=1.5)), "alternating")
    chain = mixture.chain(64, 1, seed=0)
    known = diatomic_frequencies(0.5, 1.5, 64)
    torch.testing.assert_close(tc.normal_modes(chain).frequencies[0, 1:], known[1:], rtol=1e-10, atol=0)
    gap = math.sqrt(2 / 1.5), math.sqrt(2 / 0.5)
    assert not bool(((known > gap[0] + 1e-12) & (known < gap[1] - 1e-12)).any())
    assert float(known[-1]) == pytest.approx(math.sqrt(2 * (1 / 0.5 + 1 / 1.5)), rel=1e-12)


def test_equal_masses_give_the_monatomic_chain():
    known = 2 * torch.sin(math.pi * torch.arange(32, dtype=torch.float64) / 32).abs().sort().values
    torch.testing.assert_close(diatomic_frequencies(1.0, 1.0, 32), known, rtol=1e-10, atol=1e-10)


def test_nothing_passes_the_gap():
    """A kick at one end: what arrives behind 60 beads has no frequencies of the gap, and has those of both branches."""
    chain = Mixture((Species("light", mass=0.5), Species("heavy", mass=1.5)), "alternating").chain(512, 1, 0, "fixed")
    times = torch.arange(0, 512, 0.5, dtype=torch.float64)
    path = tc.evolve(chain, tc.impulse(chain, site=1, velocity=0.01), times, method="modes")
    window = torch.blackman_window(len(times), dtype=torch.float64)
    spectrum = torch.fft.rfft(window * path.velocity[0, :, 60]).abs().square()
    frequency = 2 * math.pi * torch.fft.rfftfreq(len(times), 0.5, dtype=torch.float64)
    gap = (frequency > math.sqrt(2 / 1.5) + 0.05) & (frequency < 2 - 0.05)
    passed = (frequency > 0.2) & (frequency < 1.05)
    optical = (frequency > 2.02) & (frequency < 2.28)
    assert float(spectrum[gap].median()) < 1e-5 * float(spectrum[passed].median())
    assert float(spectrum[optical].median()) > 1e-3 * float(spectrum[passed].median())


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_contacts_follow_the_series_rule(boundary):
    mixture = Mixture(PAIR)
    chain, labels = mixture.chain(40, 3, 7, boundary), mixture.labels(40, 3, 7)
    for r in range(3):
        ends = [int(x) for x in labels[r]]
        row = [ends[0], *ends, ends[-1]] if boundary == "fixed" else [ends[-1], *ends]
        for c, (a, b) in enumerate(zip(row, row[1:], strict=False)):
            k = {0: 0.3, 1: 1.5}
            assert float(chain.contact_stiffness[r, c]) == pytest.approx(2 / (1 / k[a] + 1 / k[b]), rel=1e-14)
            assert float(chain.contact_damping[r, c]) == (0.1 if a == b == 0 else 0.0)
    given = Mixture(PAIR, unlike=(0.7, 0.02)).chain(40, 3, 7, boundary)
    assert set(np.unique(given.contact_stiffness.numpy())) == {0.3, 0.7, 1.5}


def test_labels_depend_on_seed_and_realization_alone():
    mixture = Mixture((Species("a", fraction=0.2), Species("b", fraction=0.8)))
    labels = mixture.labels(5000, 4, seed=3)
    assert torch.equal(mixture.labels(5000, [2], seed=3)[0], labels[2])
    assert torch.equal(mixture.labels(100, 4, seed=3), labels[:, :100])
    assert not torch.equal(mixture.labels(5000, 4, seed=4), labels)
    assert float((labels == 0).double().mean()) == pytest.approx(0.2, abs=5 * math.sqrt(0.16 / 20000))
    blocks = Mixture(mixture.species, "blocks").labels(10, 1, 0)
    assert blocks[0].tolist() == [0, 0, 1, 1, 1, 1, 1, 1, 1, 1]


def test_energies_of_species_sum_up():
    mixture = Mixture(tuple(Species(s.name, s.mass, s.stiffness) for s in PAIR))
    chain, labels = mixture.chain(32, 2, 1, disorder=tc.Disorder(strength=0.1)), mixture.labels(32, 2, 1)
    state = tc.standing_wave(chain, tone=[3, 9])
    path = tc.evolve(chain, state, torch.linspace(0, 60, 5))
    bands = species_band_energy(chain, path, labels, 2, n_bands=4, definition="site")
    assert tuple(bands.shape) == (2, 2, 5, 2, 4)
    scale = float(bands.abs().max())
    torch.testing.assert_close(
        bands.sum(-2), tc.band_energy(chain, path, n_bands=4, normalize=False), rtol=0, atol=1e-12 * scale
    )
    whole = species_band_energy(chain, path, labels, 2, n_bands=1, definition="site")[..., 0]
    site = species_energy(chain, path, labels, 2, definition="site")
    rest = site - whole  # at k = 0
    assert float(rest.abs().max()) < 0.05 * scale
    total = tc.total_energy(chain, path)
    torch.testing.assert_close(site.sum(-1), total, rtol=1e-10, atol=0)
    bond = species_band_energy(chain, path, labels, 2, n_bands=4)
    assert float(bond.min()) >= 0
    at_rest = (total - bond.sum((-1, -2))) / total  # the share of k = 0
    assert float(at_rest.min()) > -1e-12
    assert float(at_rest.max()) < 0.1


def test_complex_modes_against_scipy():
    from scipy.linalg import eig

    chain = Mixture(PAIR).chain(12, 1, 5, "fixed")
    unit = torch.eye(12, dtype=torch.float64)
    damping = -chain.damping_force(unit[None])[0]
    mass = torch.diag(chain.masses[0])
    first = np.block([[np.zeros((12, 12)), np.eye(12)], [chain.stiffness_matrix()[0].numpy(), -damping.numpy()]])
    second = np.block([[np.eye(12), np.zeros((12, 12))], [np.zeros((12, 12)), mass.numpy()]])
    values = eig(first, second, right=False)
    known = values[values.imag > 0]
    known = known[np.argsort(known.imag)]
    found = damped_modes(chain)
    np.testing.assert_allclose(found.frequencies[0], known.imag, rtol=1e-9)
    np.testing.assert_allclose(found.decays[0], -known.real, rtol=1e-7, atol=1e-12)


def test_overdamped_motions_are_two_modes():
    chain = tc.Chain(torch.ones(3, dtype=torch.float64), "fixed", damping=1.5)
    modes = damped_modes(chain)
    w2 = (2 * torch.sin(torch.arange(1, 4, dtype=torch.float64) * torch.pi / 8)).square()
    decays = [0.75 * w for w in w2.tolist()]
    free = [d for d, w in zip(decays, w2.tolist(), strict=True) if d**2 < w]
    assert len(free) < 3
    assert len(modes.decays) == len(free) + 2 * (3 - len(free))
    assert float(modes.decays.sum()) == pytest.approx(sum(d if d in free else 2 * d for d in decays), rel=1e-9)


def test_kept_and_dissipated_energy_is_the_start():
    mixture = Mixture(PAIR)
    chain = mixture.chain(24, 3, 2)
    path = tc.evolve(chain, tc.standing_wave(chain, tone=4), [0.0, 5.0, 50.0], method="damped")
    total = tc.total_energy(chain, path)
    torch.testing.assert_close(total + path.dissipated, total[:, :1].expand(3, 3), rtol=1e-10, atol=0)
    assert bool((path.dissipated[:, -1] > 0.1 * total[:, 0]).all())


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: Species("a", mass=0.0), "species.mass must be"),
        (lambda: Species("a", damping=-1.0), "species.damping must"),
        (lambda: Species("a", fraction=1.5), "species.fraction must be"),
        (lambda: Mixture(()), "species must be a sequence"),
        (lambda: Mixture((Species("a"), Species("a"))), "different names"),
        (lambda: Mixture((Species("a"), Species("b", fraction=0.1))), "sum up to 1"),
        (lambda: Mixture(PAIR, "stacked"), "arrangement must be"),
        (lambda: Mixture(PAIR, unlike=(0.0, 0.0)), "unlike stiffness must be"),
        (lambda: Mixture(PAIR).labels(1, 1, 0), "n_particles must be"),
        (lambda: diatomic_frequencies(1.5, 0.5, 8), "heavy must be"),
        (lambda: diatomic_frequencies(0.5, 1.5, 7), "n_particles must be even"),
        (lambda: damped_modes(tc.Chain(torch.ones(4), contact="hertz")), "contact must be 'linear'"),
    ],
)
def test_mistakes_are_named(make, rule):
    with pytest.raises((tc.FieldError, tc.FieldTypeError), match=rule):
        make()
