"""Band energies straight from the modes, against the literal Eq. 42 in NumPy."""

import literal
import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.energy.modal_bands import modal_band_energy

N, BANDS = 32, 8
TIMES = [0.0, 1.0, 50.0, 5000.0]


@pytest.mark.parametrize(
    ("boundary", "random_contacts"), [("periodic", False), ("periodic", True), ("fixed", False), ("fixed", True)]
)
def test_equals_the_literal_matrix(boundary, random_contacts):
    masses = tc.Disorder().masses(N, 2, 3)
    n_contacts = N + (boundary == "fixed")
    stiffness = (
        tc.Disorder(strength=0.2).stiffnesses(n_contacts, 2, 3) if random_contacts else torch.ones(2, n_contacts)
    )
    chain = tc.Chain(masses, boundary, stiffness.double())
    state = tc.standing_wave(chain, 5) + tc.impulse(chain, 7, 0.02)
    found = modal_band_energy(chain, state, TIMES, BANDS).numpy()
    for r in range(2):
        matrix = literal.stiffness_matrix(stiffness[r].numpy(), N, boundary)
        b = masses[r].numpy()
        u, v = literal.states(b, matrix, state.displacement[r].numpy(), state.velocity[r].numpy(), TIMES)
        for i in range(len(TIMES)):
            expected = literal.band_energy(b, matrix, u[i], v[i], BANDS)
            # Phases w t carry the reference solver's own error in w, about t eps: 1e-12 of the energy at t = 5000.
            assert np.abs(found[r, i] - expected).max() < 1e-10


def test_several_tones_windows_and_normalization():
    chain = tc.Chain(tc.Disorder().masses(N, 3, 0))
    state = tc.standing_wave(chain, [3, 6, 11])
    times = torch.arange(0.0, 6.0, 0.5, dtype=torch.float64)
    bands = modal_band_energy(chain, state, times, BANDS)
    assert bands.shape == (3, 3, 12, BANDS)
    torch.testing.assert_close(bands.sum(-1), torch.ones(3, 3, 12, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(modal_band_energy(chain, state, times[5:], BANDS), bands[:, :, 5:], rtol=0, atol=1e-13)


def test_refuses_hertz_contacts_and_states_without_energy():
    masses = torch.ones(8, dtype=torch.float64)
    hertz = tc.Chain(masses, contact="hertz")
    with pytest.raises(ValueError, match="contact must be 'linear'"):
        modal_band_energy(hertz, tc.impulse(hertz), [1.0], 4)
    chain = tc.Chain(masses)
    still = tc.State(torch.zeros(8, dtype=torch.float64), torch.zeros(8, dtype=torch.float64))
    with pytest.raises(ValueError, match="total energy must be positive"):
        modal_band_energy(chain, still, [1.0], 4)
