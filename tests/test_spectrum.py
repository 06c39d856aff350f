import warnings

import numpy as np
import pytest
import torch
from literal import modes as literal_modes
from literal import stiffness_matrix

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.modes.spectrum import DecompositionError, checked_modes

EPS = np.finfo(float).eps


def disordered(n, boundary, realizations=4, seed=0):
    masses = tc.Disorder("normal", 0.4).masses(n, realizations, seed)
    contacts = n + (boundary == "fixed")
    return tc.Chain(masses, boundary, tc.Disorder("uniform", 0.3).stiffnesses(contacts, realizations, seed))


@pytest.mark.parametrize("n", [2, 3, 16, 201])
def test_ordered_fixed_chain(n):
    frequencies = tc.normal_modes(tc.Chain(torch.ones(n, dtype=torch.float64), "fixed")).frequencies.numpy()
    j = np.arange(1, n + 1)
    # Relative to each frequency itself, also the lowest: w^2 from eigh alone is off by 1e-16 of the largest.
    np.testing.assert_allclose(frequencies, 2 * np.sin(j * np.pi / (2 * (n + 1))), rtol=1e-13)


@pytest.mark.parametrize("n", [2, 3, 16, 200])
def test_ordered_ring(n):
    frequencies = tc.normal_modes(tc.Chain(torch.ones(n, dtype=torch.float64))).frequencies.numpy()
    assert frequencies[0] == 0
    expected = np.sort(2 * np.abs(np.sin(np.pi * np.arange(n) / n)))
    np.testing.assert_allclose(frequencies, expected, rtol=1e-13)


def test_units():
    # w^2 scales as stiffness over mass.
    chain = tc.Chain(torch.full((8,), 3.0, dtype=torch.float64), stiffness=12.0)
    unit = tc.normal_modes(tc.Chain(torch.ones(8, dtype=torch.float64))).frequencies
    assert torch.allclose(tc.normal_modes(chain).frequencies, 2 * unit, rtol=1e-13, atol=0)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("n", [2, 5, 40])
def test_modes_of_disordered_chains(n, boundary):
    chain = disordered(n, boundary)
    modes = tc.normal_modes(chain)
    for i in range(4):
        masses, shapes = np.diag(chain.masses[i].numpy()), modes.shapes[i].numpy()
        matrix = stiffness_matrix(chain.contact_stiffness[i].numpy(), n, boundary)
        squared = modes.frequencies[i].numpy() ** 2
        scale = squared[-1] * n
        np.testing.assert_allclose(shapes.T @ masses @ shapes, np.eye(n), atol=20 * n * EPS)
        # Eq. 16 in units of the largest force of a mode
        np.testing.assert_allclose(-matrix @ shapes, masses @ shapes * squared, atol=20 * scale * EPS)
        expected, _ = literal_modes(chain.masses[i].numpy(), matrix)
        np.testing.assert_allclose(squared, expected**2, atol=20 * scale * EPS)


def test_batches_and_dtypes():
    chain = disordered(12, "periodic", 6)
    stacked = tc.Chain(chain.masses.reshape(2, 3, 12), "periodic", chain.contact_stiffness.reshape(2, 3, 12))
    together = tc.normal_modes(stacked).frequencies
    assert together.shape == (2, 3, 12)
    for i in range(6):
        alone = tc.normal_modes(tc.Chain(chain.masses[i], "periodic", chain.contact_stiffness[i])).frequencies
        assert torch.allclose(together.reshape(6, 12)[i], alone, rtol=1e-13, atol=0)
    single = tc.normal_modes(tc.Chain(chain.masses.float(), "periodic", chain.contact_stiffness.float()))
    assert single.frequencies.dtype == single.shapes.dtype == torch.float32
    assert torch.allclose(single.frequencies.double(), together.reshape(6, 12), atol=1e-5)
    assert tc.normal_modes(tc.Chain(torch.ones(0, 12))).frequencies.shape == (0, 12)


def test_the_zero_mode_of_a_ring_is_uniform():
    chain = disordered(17, "periodic")
    uniform = tc.normal_modes(chain).shapes[:, :, 0]
    expected = chain.masses.sum(-1, keepdim=True).rsqrt().expand(4, 17)
    assert torch.allclose(uniform, expected, rtol=1e-14, atol=0)


def test_hertz_chains_are_linearized_at_the_initial_overlap():
    chain = disordered(9, "fixed")
    hertz = tc.Chain(chain.masses, "fixed", chain.stiffness, "hertz")
    assert torch.equal(tc.normal_modes(hertz).frequencies, tc.normal_modes(chain).frequencies)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_gradient_of_the_frequencies(boundary):
    # Perturbation theory: d w_j / d b_p = -w_j s_j(p)^2 / 2, and no change of the zero mode.
    masses = tc.Disorder("uniform", 0.3).masses(9, 1, 3)[0].requires_grad_(True)
    modes = tc.normal_modes(tc.Chain(masses, boundary))
    for j in range(9):
        (gradient,) = torch.autograd.grad(modes.frequencies[j], masses, retain_graph=True)
        expected = -modes.frequencies[j] * modes.shapes[:, j].square() / 2
        assert torch.allclose(gradient, expected, atol=1e-11)


def test_gradient_is_finite_beside_an_exactly_uniform_mode():
    # Equal square roots of equal masses: the elongation of the zero mode is exactly 0, where a square root has no slope.
    masses = torch.tensor([1.0, 1.0], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(tc.normal_modes(tc.Chain(masses)).frequencies.sum(), masses)
    # two contacts of stiffness 1 between them: w^2 = 2 (1 / b1 + 1 / b2)
    assert torch.allclose(gradient, torch.tensor([-0.5, -0.5], dtype=torch.float64), atol=1e-12)


def eigenvectors(chain):
    weight = chain.masses.rsqrt()
    symmetric = -chain.stiffness_matrix() * weight[..., :, None] * weight[..., None, :]
    return torch.linalg.eigh(symmetric)[1]


def wrong_direction(vectors):
    vectors[2, :, 3] = vectors[2, :, 3].roll(1)


def rotated(vectors):
    a, b = vectors[2, :, 3].clone(), vectors[2, :, 4].clone()
    vectors[2, :, 3], vectors[2, :, 4] = 0.8 * a + 0.6 * b, 0.8 * b - 0.6 * a  # orthonormal, but no modes


def too_long(vectors):
    vectors[2, :, 5] *= 1 + 1e-10


def repeated(vectors):
    vectors[2, :, 5] = vectors[2, :, 4]


def undefined(vectors):
    vectors[2, 1, 1] = torch.nan


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("corrupt", [wrong_direction, rotated, too_long, repeated, undefined])
def test_corrupted_modes_are_refused(boundary, corrupt):
    chain = disordered(10, boundary)
    vectors = eigenvectors(chain)
    good = checked_modes(chain, vectors.clone())
    assert torch.allclose(good.frequencies, tc.normal_modes(chain).frequencies)
    corrupt(vectors)
    with pytest.raises(DecompositionError, match="residual .* at realization 3$"):
        checked_modes(chain, vectors)


def test_a_failing_solver_is_reported(monkeypatch):
    real = torch.linalg.eigh

    def sloppy(matrix):
        values, vectors = real(matrix.float())
        return values.double(), vectors.double()

    monkeypatch.setattr(torch.linalg, "eigh", sloppy)
    with pytest.raises(DecompositionError, match="at realization 1"):
        tc.normal_modes(disordered(10, "fixed"))


@pytest.mark.parametrize("masses", [[1e-308, 1.0, 1.0], [1e308, 1e308, 1.0], [1e-300, 1e300, 1.0], [5e-324, 1.0, 1.0]])
def test_masses_beyond_the_solver(masses):
    with pytest.raises(DecompositionError):
        tc.normal_modes(tc.Chain(masses))


def test_stiffness_beyond_the_solver():
    with pytest.raises(DecompositionError):
        tc.normal_modes(tc.Chain(tc.Disorder().masses(8, 3, 0), stiffness=1e308))


def test_damped_chains_have_no_normal_modes():
    with pytest.raises(FieldError, match="damping must be zero for normal modes .*got up to 0.1"):
        tc.normal_modes(tc.Chain(torch.ones(4), damping=0.1))


def test_two_modes_are_no_wide_spectrum():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.normal_modes(tc.Chain(torch.tensor([1.0, 1.2], dtype=torch.float64)))
