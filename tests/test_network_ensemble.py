"""Ensembles of networks made from any one: their transfer against dense algebra, seeds, checkpoints, bad input."""

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain import network as nw
from torchchain.checks import FieldError
from torchchain.ensemble import network_ensembles, network_transfer

TIMES = [0.0, 1.0, 7.0]
LAW = tc.Disorder(strength=0.3)


@pytest.fixture(scope="module")
def disks():
    """A packing in no order, its contacts under no pressure."""
    grid = nw.displaced(nw.lattice("square", (7, 6)), 0.25, seed=1)
    radii = torch.full((grid.n_particles,), 0.7, dtype=torch.float64)
    return tc.packing(grid.positions, radii, grid.masses, [7.0, 6.0], prestress=False)


def transfer(disks, realizations=3, **changes):
    return network_transfer(disks, TIMES, 2, **{"masses": LAW, "realizations": realizations, "seed": 5} | changes)


def test_transfer_is_that_of_dense_algebra(disks):
    found = transfer(disks, stiffness=LAW, removed_bonds=0.1)
    bands = nw.packing_bands(disks, 2)
    q = nw.box_wavevectors(disks, bands.largest).numpy()
    expected = []
    for i in range(3):
        made = nw.disordered(disks, LAW, LAW, [i], 5)
        kept = nw.diluted(disks, 0.1, [i], 5).stiffness[0] > 0
        mass, stiffness = made.masses[0].numpy().repeat(2), (made.stiffness[0] * kept).numpy()
        incidence = np.zeros((disks.n_bonds, 2 * disks.n_particles))
        for b, (p, r) in enumerate(disks.bonds.tolist()):
            incidence[b, 2 * r : 2 * r + 2] += disks.directions[b].numpy()
            incidence[b, 2 * p : 2 * p + 2] -= disks.directions[b].numpy()
        dynamical = (incidence.T * stiffness) @ incidence / np.sqrt(np.outer(mass, mass))
        squared, modes = np.linalg.eigh(dynamical)
        w = np.sqrt(squared.clip(0))
        waves, shells = [], []
        for k in q:  # the two phases along q, then across, and both directions at q = 0
            x = disks.positions.numpy() @ k
            along = k / np.linalg.norm(k) if k.any() else np.array([1.0, 0.0])
            shell = np.searchsorted(bands.edges.numpy(), np.linalg.norm(k) * (1 - 1e-12)) - 1
            for wave in (np.cos(x), np.sin(x)) if k.any() else (np.cos(x),):
                for kind, e in enumerate((along, np.array([-along[1], along[0]]))):
                    waves.append((wave[:, None] * e).reshape(-1) * np.sqrt(mass))
                    shells.append(2 * kind + shell if k.any() else 4)
        values, vectors = np.linalg.eigh(np.array(waves) @ np.array(waves).T)
        basis = (vectors / np.sqrt(values)) @ vectors.T @ np.array(waves)  # nearest orthonormal rows
        starts = nw.band_starts(made, bands, i, 5).displacement[0].numpy().reshape(5, -1) * np.sqrt(mass)
        rows = []
        for y0 in starts:
            series = []
            for t in TIMES:
                y, v = (modes @ (f * (modes.T @ y0)) for f in (np.cos(w * t), -w * np.sin(w * t)))
                each = ((basis @ v) ** 2 + (basis @ y) * (basis @ (dynamical @ y))) / 2
                energy = np.array([each[np.array(shells) == s].sum() for s in range(5)])
                total = (v @ v + y @ dynamical @ y) / 2
                energy[4] += total - each.sum()
                series.append(energy / total)
            rows.append(series)
        expected.append(rows)
    assert np.abs(found.mean.numpy() - np.mean(expected, 0)).max() < 1e-9
    assert np.abs(found.stderr.numpy() - np.std(expected, 0, ddof=1) / 3**0.5).max() < 1e-9
    assert torch.allclose(found.mean[:, 0], torch.eye(5, dtype=torch.float64), atol=1e-9)


def test_realizations_are_those_of_the_seed_and_a_killed_run_goes_on(disks, tmp_path, monkeypatch):
    whole = transfer(disks)
    kept = tc.Checkpoint(tmp_path / "kept", every=0)
    module = network_ensembles
    real, seen = module.band_starts, []

    def stopped(made, bands, i, seed):
        if i == 2 and not seen:
            seen.append(i)
            raise KeyboardInterrupt
        return real(made, bands, i, seed)

    monkeypatch.setattr(module, "band_starts", stopped)
    with pytest.raises(KeyboardInterrupt):
        transfer(disks, checkpoint=kept)
    again = transfer(disks, checkpoint=kept)
    assert kept.resumed == 2
    assert torch.equal(whole.mean, again.mean)
    assert torch.equal(whole.stderr, again.stderr)
    with pytest.raises(FieldError, match="seed must stay 5"):
        transfer(disks, seed=6, checkpoint=kept)
    assert not torch.equal(whole.mean, transfer(disks, seed=6).mean)


def test_a_model_is_calibrated_on_it(disks):
    found = network_transfer(disks, [*np.arange(0.0, 4.0, 0.5), 6.0, 9.0, 14.0], 1, masses=LAW, realizations=4)
    model = tc.calibrate(found, "linear", "basis_matrix")
    assert model.n_bands == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"removed_bonds": 1.0}, "removed_bonds must be"),
        ({"moved": -0.1}, "moved must be"),
        ({"realizations": 0}, "realizations must be"),
        ({"seed": -1}, "seed must be"),
        ({"method": "euler"}, "method must be"),
        ({"masses": 0.3}, "masses must be"),
    ],
)
def test_bad_input_is_one_line(disks, changes, words):
    with pytest.raises((FieldError, TypeError), match=words) as error:
        transfer(disks, **changes)
    assert "\n" not in str(error.value)


def test_networks_without_a_box_or_with_dashpots_are_refused(disks):
    with pytest.raises(FieldError, match="box must be periodic"):
        network_transfer(tc.lattice("square", (4, 4), boundary="free"), TIMES)
    with pytest.raises(FieldError, match="damping must be zero"):
        network_transfer(tc.packing(disks.positions, disks.radii, disks.masses, disks.box, damping=0.1), TIMES)
    with pytest.raises(FieldError, match="times must begin at 0"):
        network_transfer(disks, [1.0, 2.0])
