import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import torch
from literal import stiffness_matrix

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError


def random_chain(n, boundary, batch=(), seed=0, contact="linear"):
    count = int(np.prod(batch)) if batch else 1
    masses = tc.Disorder("uniform", 0.4).masses(n, count, seed).reshape(*batch, n)
    contacts = n + (boundary == "fixed")
    stiffness = tc.Disorder("gamma", 0.5).stiffnesses(contacts, count, seed).reshape(*batch, contacts)
    return tc.Chain(masses, boundary, stiffness, contact)


def field(shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("n", [2, 3, 7])
def test_stiffness_matrix_is_the_sum_over_contacts(n, boundary):
    chain = random_chain(n, boundary, (2, 3))
    matrices = chain.stiffness_matrix()
    assert matrices.shape == (2, 3, n, n)
    for i in range(2):
        for j in range(3):
            expected = stiffness_matrix(chain.contact_stiffness[i, j].numpy(), n, boundary)
            np.testing.assert_allclose(matrices[i, j].numpy(), expected, atol=1e-15)


def test_stiffness_matrix_of_unit_contacts():
    fixed = tc.Chain(torch.ones(4), "fixed").stiffness_matrix().numpy()
    np.testing.assert_array_equal(fixed, scipy.linalg.toeplitz([-2, 1, 0, 0]))
    ring = tc.Chain(torch.ones(4), "periodic").stiffness_matrix().numpy()
    np.testing.assert_array_equal(ring, scipy.linalg.circulant([-2, 1, 0, 1]))
    pair = tc.Chain(torch.ones(2), "periodic", torch.tensor([1.0, 3.0])).stiffness_matrix().numpy()
    np.testing.assert_array_equal(pair, [[-4, 4], [4, -4]])  # two particles share both contacts


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_linear_force_is_k_u(boundary):
    chain = random_chain(6, boundary, (2,))
    u = field((2, 4, 6))
    force = chain.force(u)
    for i in range(2):
        matrix = stiffness_matrix(chain.contact_stiffness[i].numpy(), 6, boundary)
        np.testing.assert_allclose(force[i].numpy(), u[i].numpy() @ matrix.T, rtol=0, atol=1e-14)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_damping_force_is_minus_d_v(boundary):
    chain = random_chain(5, boundary)
    coefficients = chain.contact_stiffness / 7
    damped = tc.Chain(chain.masses, boundary, chain.contact_stiffness, damping=coefficients)
    v = field((3, 5))
    expected = v.numpy() @ stiffness_matrix(coefficients.numpy(), 5, boundary).T
    np.testing.assert_allclose(damped.damping_force(v).numpy(), expected, rtol=0, atol=1e-14)
    assert damped.is_damped
    assert not chain.is_damped


@pytest.mark.parametrize("contact", ["linear", "hertz"])
@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_force_is_minus_the_gradient_of_the_energy(boundary, contact):
    chain = random_chain(6, boundary, (2,), contact=contact)
    u = field((2, 6), scale=0.8).requires_grad_(True)  # elongations beyond 1: some contacts open
    if contact == "hertz":
        assert bool(chain.open_contacts(u).any())
    energy = chain.contact_energy(u)
    assert bool((energy >= 0).all())
    (gradient,) = torch.autograd.grad(energy.sum(), u)
    assert torch.allclose(chain.force(u), -gradient, rtol=1e-13, atol=1e-14)


def hertz_contact(stiffness=1.0):
    """One contact between a wall and a bead, the other contact far softer."""
    return tc.Chain(torch.ones(2, dtype=torch.float64), "fixed", stiffness, "hertz")


ELONGATIONS = [-3.0, -1.0, -0.2, -1e-3, -1e-9, 0.0, 1e-9, 1e-3, 0.3, 0.9, 1.0 - 1e-12, 1.0, 1.5, 10.0]


def tension_of(chain, elongation):
    return chain.tension(torch.full((3,), elongation, dtype=torch.float64))[0].item()


@pytest.mark.parametrize("e", ELONGATIONS)
def test_hertz_tension(e):
    # (2/3) kappa (1 - (1 - e)^(3/2)) relative to the precompressed contact; expm1 keeps the digits of a small e.
    kappa = 2.5
    expected = kappa * 2 / 3 * (-np.expm1(1.5 * np.log1p(-e)) if e < 1 else 1.0)
    assert tension_of(hertz_contact(kappa), e) == pytest.approx(expected, rel=1e-13)


def test_hertz_is_stiff_like_the_linear_contact_at_the_initial_overlap():
    chain = hertz_contact(1.7)
    for e in (1e-5, -1e-5):  # the next term of the force is e^2 / 4
        assert tension_of(chain, e) / e == pytest.approx(1.7, rel=abs(e))
    e = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(chain.tension(e).sum(), e)
    assert torch.allclose(slope, torch.full((3,), 1.7, dtype=torch.float64), rtol=1e-14)


@pytest.mark.parametrize("e", ELONGATIONS)
@pytest.mark.parametrize("contact", ["linear", "hertz"])
def test_contact_energy_is_the_integral_of_the_tension(contact, e):
    chain = tc.Chain(torch.ones(2, dtype=torch.float64), "fixed", 1.3, contact)
    integral, _ = scipy.integrate.quad(lambda x: tension_of(chain, x), 0, e, points=[1.0] if e > 1 else None, epsabs=0)
    energy = chain.contact_energy(torch.tensor([e, 0.0], dtype=torch.float64))[0].item()
    assert energy == pytest.approx(integral, rel=1e-9, abs=1e-300)


def test_open_contacts_pull_no_further():
    chain = hertz_contact()
    assert tension_of(chain, 1.0) == tension_of(chain, 7.0) == pytest.approx(2 / 3, rel=1e-15)
    opened = chain.open_contacts(torch.tensor([[0.999, 0.5], [1.0, -0.5], [2.0, 0.0]], dtype=torch.float64))
    assert opened.tolist() == [[False, False, False], [True, False, False], [True, False, False]]


def test_elongation_of_walls_and_ring():
    u = torch.tensor([1.0, 4.0, 9.0])
    assert tc.Chain(torch.ones(3), "fixed").elongation(u).tolist() == [1, 3, 5, -9]
    assert tc.Chain(torch.ones(3), "periodic").elongation(u).tolist() == [-8, 3, 5]


EXCESS = 1e-2  # of w^2: half a percent more Chebyshev terms than the exact bound would need


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("kind", ["uniform", "normal", "gamma", "binary"])
def test_squared_frequency_bound(kind, boundary):
    masses = tc.Disorder(kind, 0.5).masses(48, 20, 1)
    contacts = 48 + (boundary == "fixed")
    stiffness = tc.Disorder(kind, 0.3).stiffnesses(contacts, 20, 2)
    for chain in (tc.Chain(masses, boundary), tc.Chain(masses, boundary, stiffness)):
        bound = chain.squared_frequency_bound().numpy()
        for i in range(20):
            matrix = stiffness_matrix(chain.contact_stiffness[i].numpy(), 48, boundary)
            weight = masses[i].numpy() ** -0.5
            largest = scipy.linalg.eigvalsh(-matrix * np.outer(weight, weight))[-1]
            assert largest * (1 - 1e-14) <= bound[i] <= largest * (1 + EXCESS)


def test_squared_frequency_bound_of_ordered_chains():
    assert tc.Chain(torch.ones(10, dtype=torch.float64)).squared_frequency_bound().item() == pytest.approx(4, rel=1e-14)
    exact = (2 * np.sin(10 * np.pi / 22)) ** 2
    bound = tc.Chain(torch.ones(10, dtype=torch.float64), "fixed").squared_frequency_bound().item()
    assert exact <= bound <= exact * (1 + EXCESS)


@pytest.mark.parametrize("sweeps", [0, 1, 3])
def test_squared_frequency_bound_holds_after_any_number_of_sweeps(sweeps):
    chain = random_chain(30, "periodic", (5,))
    true = tc.normal_modes(chain).frequencies[:, -1].square()
    assert bool((chain.squared_frequency_bound(sweeps) >= true * (1 - 1e-14)).all())


def test_squared_frequency_bound_of_extreme_chains():
    for values in ([1e-8, 1.0, 1e8, 1.0], [1e150, 1e-150, 1.0, 1.0]):
        chain = tc.Chain(torch.tensor(values, dtype=torch.float64))
        bound = chain.squared_frequency_bound().item()
        # The lightest particle alone between its neighbors swings with w^2 = 2 / b at least.
        assert 2 / min(values) <= bound < 4.01 / min(values)


def test_dtype_and_batch_follow_the_masses():
    chain = tc.Chain(torch.ones(2, 5, dtype=torch.float32), stiffness=torch.ones(5, dtype=torch.float64))
    assert chain.contact_stiffness.dtype == torch.float32
    assert chain.contact_stiffness.shape == (2, 5)
    assert chain.batch_shape == (2,)
    assert tc.Chain([1, 2, 3]).masses.dtype == torch.float64


def test_uniform_ring():
    ones = torch.ones(2, 4, dtype=torch.float64)
    assert tc.Chain(ones, stiffness=3.0).is_uniform_ring
    assert tc.Chain(ones, stiffness=2 * ones).is_uniform_ring
    assert not tc.Chain(ones, stiffness=torch.tensor([1.0, 1.0, 1.0, 2.0])).is_uniform_ring
    assert not tc.Chain(ones, stiffness=torch.stack([ones[0], 2 * ones[0]])).is_uniform_ring
    assert not tc.Chain(ones, "fixed").is_uniform_ring
    assert not tc.Chain(ones, contact="hertz").is_uniform_ring


MASSES = torch.ones(3, 4, dtype=torch.float64)


@pytest.mark.parametrize(
    ("masses", "fields", "error", "message"),
    [
        ([1.0], {}, FieldError, "masses must hold at least 2 particles"),
        (torch.tensor(1.0), {}, FieldError, "masses must hold at least 2 particles"),
        ([], {}, FieldError, "masses must hold at least 2 particles"),
        ([[1, 1], [1, -0.31]], {}, FieldError, "masses must be positive, got -0.31 at realization 2, particle 2"),
        ([1, 0, 1], {}, FieldError, "masses must be positive, got 0 at particle 2"),
        ([1, float("nan")], {}, FieldError, "masses must be finite, got nan"),
        ([1, float("inf")], {}, FieldError, "masses must be finite, got inf"),
        ([1, 10**400], {}, FieldError, "masses must be finite"),
        ([1, 1j], {}, FieldTypeError, "masses must be real"),
        (np.array([1, 1j]), {}, FieldTypeError, "masses must be real"),
        ([True, True], {}, FieldTypeError, "masses must be real"),
        ([None, 1], {}, FieldTypeError, "masses must be real"),
        ([[1, 1], [1]], {}, FieldTypeError, "masses must be real"),
        ("ab", {}, FieldTypeError, "masses must be real"),
        (None, {}, FieldTypeError, "masses must be real"),
        (torch.ones(4, dtype=torch.bool), {}, FieldTypeError, "masses must be real"),
        (torch.ones(4, dtype=torch.complex64), {}, FieldTypeError, "masses must be real"),
        (torch.ones(4, dtype=torch.float16), {}, FieldTypeError, "masses must be of dtype float32 or float64"),
        (MASSES, {"boundary": "open"}, FieldError, "boundary must be one of periodic, fixed, got 'open'"),
        (MASSES, {"boundary": None}, FieldTypeError, "boundary must be a string"),
        (MASSES, {"contact": "glue"}, FieldError, "contact must be one of linear, hertz, got 'glue'"),
        (MASSES, {"stiffness": 0}, FieldError, "stiffness must be positive, got 0"),
        (MASSES, {"stiffness": float("inf")}, FieldError, "stiffness must be finite"),
        (MASSES, {"stiffness": True}, FieldTypeError, "stiffness must be real"),
        (MASSES, {"stiffness": None}, FieldTypeError, "stiffness must be real"),
        (MASSES, {"stiffness": torch.ones(5)}, FieldError, r"stiffness must be a number or have shape \(4,\)"),
        (MASSES, {"stiffness": torch.ones(1, 4)}, FieldError, r"or \(3, 4\), got shape \(1, 4\)"),
        (MASSES, {"stiffness": -MASSES}, FieldError, "stiffness must be positive, got -1 at realization 1, contact 1"),
        (MASSES, {"boundary": "fixed", "stiffness": MASSES}, FieldError, r"have shape \(5,\)"),
        (MASSES, {"damping": -1}, FieldError, "damping must not be negative, got -1"),
        (MASSES, {"damping": float("nan")}, FieldError, "damping must be finite"),
    ],
)
def test_bad_fields(masses, fields, error, message):
    with pytest.raises(error, match=message):
        tc.Chain(masses, **fields)
