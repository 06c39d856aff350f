"""Band transfers of scalar lattices from theory: against the chain's own, against ensembles, and what is refused."""

import pytest
import torch

import torchchain as tc
from torchchain.theory.ladder import Waves, ladder_transfer, spectrum_edges

TIMES = torch.tensor([0.0, 1.0, 3.0, 10.0, 30.0], dtype=torch.float64)


def test_the_chain_is_the_lattice_in_one_dimension():
    n, bands, tones = 64, 8, [2, 14, 30]
    disorder = tc.Disorder(strength=0.3)
    law = tc.theory.law_of(disorder)
    k = 2 * torch.pi / n * torch.tensor(tones, dtype=torch.float64)
    waves = Waves(n, bands, 4 * torch.sin(k / 2).square(), torch.tensor([0, 3, 7]))
    ring = ladder_transfer(law, waves, TIMES, spectrum_edges(law))
    # The wave nearest to the middle of shell s, of tones 4s-3 to 4s, is 4s-2: 2, 14, 30 are those of 1, 4 and 8.
    found = tc.theory.lattice_transfer(disorder, "chain", (n,), bands, TIMES, [1, 4, 8])
    # Two grids of frequencies: what either leaves out is 3e-7 of the modes and the rounding of a contour at eta.
    torch.testing.assert_close(found, ring / ring.sum(-1, keepdim=True), rtol=0, atol=2e-5)


@pytest.mark.parametrize(("kind", "strength"), [("square", 0.15), ("triangular", 0.2)])
def test_lattices_follow_the_ladder_within_their_error(kind, strength):
    scene = tc.Scene(
        lattice=kind, shape=(16, 16), motion="scalar", n_bands=5, times=TIMES[:4].tolist(), realizations=60, seed=3,
        disorder=tc.Disorder(strength=strength),
    )  # fmt: skip
    chains, theory = tc.band_transfer(scene, long_time=False), tc.band_transfer(scene, method="theory")
    assert theory.long_time is None
    assert theory.systematic is None
    assert float(theory.stderr.abs().max()) == 0
    torch.testing.assert_close(theory.mean.sum(-1), torch.ones(5, 4, dtype=torch.float64), rtol=0, atol=1e-12)
    # Where an ensemble's mean has the error sigma in each band, its total variation from the truth is about this.
    noise = tc.statistical_distance(chains.stderr) / 2**0.5
    distance = tc.total_variation(theory.mean, chains.mean)
    assert float(distance[:, 1:].mean()) < 1.5 * float(noise[:, 1:].mean()) + 1e-3
    later = scene.times == 10
    moved = tc.total_variation(theory.mean[:, later], theory.mean[:, :1])
    assert float(moved.max()) > 20 * float(distance[:, later].max())  # the waves have long scattered


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("motion", {"motion": "vector", "n_bands": 8}),
        ("damping", {"damping": 0.1}),
        ("removed_bonds", {"removed_bonds": 0.1}),
        ("stiffness_disorder", {"stiffness_disorder": tc.Disorder(strength=0.1)}),
        ("times", {"times": [0.0, 500.0]}),
    ],
)
def test_what_the_ladder_does_not_hold_for_is_refused(field, change):
    scene = {"lattice": "square", "shape": (12, 12), "motion": "scalar", "n_bands": 4, "times": [0.0, 1.0]} | change
    with pytest.raises(tc.FieldError, match=f"^{field}"):
        tc.band_transfer(tc.Scene(**scene), method="theory")
