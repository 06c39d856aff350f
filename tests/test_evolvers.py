"""What every way to evolve a chain must do, tried on the whole registry; an entry's own words say what to skip."""

import inspect
import re
from dataclasses import replace
from functools import cache

import mpmath  # comes with torch
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.evolvers import METHODS, ode, start, symplectic
from torchchain.evolvers.compositions import PEFRL, VERLET

TIMES = torch.tensor([0.0, 0.3, 1.0, 1.25, 4.0], dtype=torch.float64)
EXACT = [name for name, entry in METHODS.items() if entry.order.startswith("exact")]
STEPPED = [name for name, entry in METHODS.items() if "step" in entry.options]
ADAPTIVE = [name for name, entry in METHODS.items() if "rtol" in entry.options]
GENERAL = [entry.name for entry in ode.METHODS]
DIFFERENTIABLE = [name for name, entry in METHODS.items() if "gradient" not in entry.cannot]
# Other tables of coefficients in the same code as dopri5 and rk4: their accuracy is looked at, their paths are those of these two.
TABLES_ALONE = ("bosh3", "adaptive_heun", "fehlberg2", "midpoint", "heun2", "heun3")
PATHS = [name for name in METHODS if name not in TABLES_ALONE]
# Multistep methods start afresh in every window and at every change of step.
SELF_STARTING = [name for name in METHODS if name not in ADAPTIVE and not name.endswith("adams")]

# Options that make a method accurate and yet quick, and the error they leave in units of the largest displacement.
OPTIONS = {
    "verlet": {"step": 1e-3},
    "symplectic4": {"step": 0.02},
    "adaptive_heun": {"rtol": 1e-4},
    "fehlberg2": {"rtol": 1e-6},
    "bosh3": {"rtol": 1e-5},
} | {name: {"step": 0.02} for name in ("midpoint", "heun2", "heun3", "rk4", "explicit_adams", "implicit_adams")}
ERROR = {
    "verlet": 4e-6,
    "symplectic4": 1e-8,
    "dopri5": 5e-7,
    "dopri8": 1e-7,
    "bosh3": 1e-3,
    "adaptive_heun": 4e-3,
    "fehlberg2": 4e-3,
    "lsoda": 1e-6,
    "midpoint": 4e-3,
    "heun2": 4e-3,
    "heun3": 6e-5,
    "rk4": 4e-7,
    "explicit_adams": 2e-5,
    "implicit_adams": 4e-7,
}
CASES = [
    pytest.param(name, boundary, contact, damping, id=f"{name}-{boundary}-{contact}{'-damped' if damping else ''}")
    for name, entry in METHODS.items()
    for boundary in entry.boundaries
    for contact in entry.contacts
    for damping in ((0.0, 0.1) if entry.damped else (0.0,))
    # the general-purpose methods know nothing of boundaries
    if name not in GENERAL or boundary == "periodic" or (contact, damping) == ("linear", 0.0)
]
# One boundary of each path, where the boundary plays no part.
ONE_BOUNDARY = [case for case in CASES if case.values[0] in PATHS and case.values[1] == METHODS[case.values[0]].boundaries[0]]


def options(name: str) -> dict:
    return OPTIONS.get(name, {})


def error(name: str) -> float:
    return ERROR.get(name, 1e-12 if name in EXACT else 1e-9)


def a_chain(boundary="periodic", contact="linear", damping=0.0, n=10, batch=(2,), dtype=torch.float64, seed=3):
    generator = torch.Generator().manual_seed(seed)
    masses = 0.6 + 0.8 * torch.rand(*batch, n, generator=generator, dtype=torch.float64)
    n_contacts = n + (boundary == "fixed")
    stiffness = 0.8 + 0.4 * torch.rand(*batch, n_contacts, generator=generator, dtype=torch.float64)
    rates = damping * (0.5 + torch.rand(*batch, n_contacts, generator=generator, dtype=torch.float64))
    return tc.Chain(masses.to(dtype), boundary, stiffness.to(dtype), contact, rates.to(dtype))


def a_state(chain, amplitude=None, members=(), seed=4):
    generator = torch.Generator().manual_seed(seed)
    amplitude = (0.1 if chain.contact == "hertz" else 0.01) if amplitude is None else amplitude
    shape = (*chain.batch_shape, *members, chain.n_particles)
    values = [torch.randn(shape, generator=generator, dtype=torch.float64).to(chain.masses) for _ in range(2)]
    return tc.State(amplitude * values[0], amplitude * values[1])


def difference(one, other):
    return max(
        (one.displacement - other.displacement).abs().max().item(), (one.velocity - other.velocity).abs().max().item()
    )


def total_energy(chain, trajectory):
    kept = tc.total_energy(chain, trajectory)
    return kept if trajectory.dissipated is None else kept + trajectory.dissipated


def integrated(masses, stiffness, damping, periodic, hertz, displacement, velocity, times):
    """One chain by scipy's DOP853, from Eqs. 7 and 14 written out once more."""
    n = len(masses)

    def right_hand_side(_, y):
        u, v = y[:n], y[n:]
        if periodic:
            elongation, rate = u - np.roll(u, 1), v - np.roll(v, 1)
        else:
            elongation, rate = np.diff(u, prepend=0, append=0), np.diff(v, prepend=0, append=0)
        pull = stiffness * elongation + damping * rate
        if hertz:
            overlap = np.maximum(1 - elongation, 0)
            pull = stiffness * 2 / 3 * (1 - overlap**1.5) + damping * rate * (overlap > 0)
        force = np.roll(pull, -1) - pull if periodic else np.diff(pull)
        return np.concatenate([v, force / masses])

    start = np.concatenate([displacement, velocity])
    found = solve_ivp(right_hand_side, (0, times[-1]), start, "DOP853", times, rtol=1e-13, atol=1e-15)
    return found.y.T[:, :n], found.y.T[:, n:]


@cache
def reference(boundary, contact, damping):
    chain = a_chain(boundary, contact, damping)
    state = a_state(chain)
    fields = (chain.masses, chain.contact_stiffness, chain.contact_damping)
    solved = [
        integrated(m, k, c, boundary == "periodic", contact == "hertz", u, v, TIMES.numpy())
        for m, k, c, u, v in zip(
            *(x.numpy() for x in fields), state.displacement.numpy(), state.velocity.numpy(), strict=True
        )
    ]
    displacement, velocity = (torch.from_numpy(np.stack(part)) for part in zip(*solved, strict=True))
    return tc.Trajectory(TIMES, displacement, velocity)


@pytest.mark.parametrize(("name", "boundary", "contact", "damping"), CASES)
def test_agrees_with_an_independent_integration(name, boundary, contact, damping):
    chain = a_chain(boundary, contact, damping)
    trajectory = tc.evolve(chain, a_state(chain), TIMES, name, **options(name))
    expected = reference(boundary, contact, damping)
    scale = expected.displacement.abs().max().item()
    # scipy's own error is some 1e-13 per unit time
    assert difference(trajectory, expected) < (error(name) + 1e-11) * scale
    assert trajectory.displacement.shape == (2, len(TIMES), 10)
    assert (trajectory.dissipated is None) == (damping == 0)
    assert (trajectory.openings is None) == (contact == "linear")
    energy = total_energy(chain, trajectory)
    assert (energy / energy[:, :1] - 1).abs().max() < 10 * error(name)


@pytest.mark.parametrize("name", METHODS)
def test_agrees_with_modes(name):
    entry = METHODS[name]
    chain = a_chain(entry.boundaries[-1], n=24)
    state = a_state(chain, members=(3,))
    trajectory = tc.evolve(chain, state, TIMES, name, **options(name))
    expected = tc.evolve(chain, state, TIMES, "modes")
    assert difference(trajectory, expected) < error(name) * expected.displacement.abs().max()


@cache
def to_thirty_digits(boundary):
    """A chain of given masses, its start, and the states at times 50 and 1000 from its modes to 30 digits (Eqs. 19-21)."""
    n, times = 24, (50, 1000)
    chain = tc.Chain(tc.Disorder(strength=0.3).masses(n, 1, 0)[0], boundary)
    state = a_state(chain)
    drifting = (chain.masses * state.velocity).sum() / chain.masses.sum()
    state = tc.State(state.displacement, state.velocity - drifting)  # a ring must not move away as a whole
    with mpmath.workdps(30):
        masses, u, v = (mpmath.matrix(x.tolist()) for x in (chain.masses, state.displacement, state.velocity))
        root = mpmath.diag([mpmath.sqrt(b) for b in masses])
        squared, shapes = mpmath.eigsy(root**-1 * mpmath.matrix((-chain.stiffness_matrix()).tolist()) * root**-1)
        w = [mpmath.sqrt(max(x, mpmath.mpf(10) ** -50)) for x in squared]
        a, b = shapes.T * root * u, shapes.T * root * v
        found = []
        for t in times:
            cosine, sine = ([function(x * t) for x in w] for function in (mpmath.cos, mpmath.sin))
            position = [a[k] * cosine[k] + b[k] * sine[k] / w[k] for k in range(n)]
            speed = [b[k] * cosine[k] - a[k] * sine[k] * w[k] for k in range(n)]
            found += [root**-1 * shapes * mpmath.matrix(x) for x in (position, speed)]
    displacement, velocity = (
        torch.tensor([[float(x) for x in field] for field in fields], dtype=torch.float64)
        for fields in (found[0::2], found[1::2])
    )
    return chain, state, tc.Trajectory(torch.tensor(times, dtype=torch.float64), displacement, velocity)


# The other methods step with an error of a lower order, which no affordable step makes as small.
LONG = {name: {} for name in EXACT} | {"symplectic4": {"step": 1e-3}}


@pytest.mark.parametrize(
    ("name", "boundary"), [(name, boundary) for name in LONG for boundary in METHODS[name].boundaries]
)
def test_linear_methods_agree_to_twelve_digits_and_to_nine_at_time_1000(name, boundary):
    chain, state, expected = to_thirty_digits(boundary)
    found = tc.evolve(chain, state, expected.times, name, **LONG[name])
    scale = expected.velocity.abs().max()
    for i, tolerance in enumerate((1e-12, 1e-9)):
        for field in ("displacement", "velocity"):
            assert (getattr(found, field)[i] - getattr(expected, field)[i]).abs().max() < tolerance * scale


@pytest.mark.parametrize("name", METHODS)
def test_reciprocity(name):
    """What p does at q by a push is what q does at p by the same one, damped or not."""
    entry = METHODS[name]
    chain = a_chain(entry.boundaries[-1], damping=0.1 if entry.damped else 0.0, batch=())
    p, q = 2, 7
    pushed = torch.zeros(2, chain.n_particles, dtype=torch.float64)
    pushed[0, p], pushed[1, q] = 0.01 / chain.masses[p], 0.01 / chain.masses[q]
    found = [
        tc.evolve(chain, tc.State(torch.zeros_like(v), v), TIMES, name, **options(name)).displacement for v in pushed
    ]
    reached = found[0][:, q].abs().max()
    assert reached > 1e-4
    assert (found[0][:, q] - found[1][:, p]).abs().max() < max(error(name), 1e-12) * 0.05


@pytest.mark.parametrize("name", METHODS)
def test_two_particles(name):
    entry = METHODS[name]
    for boundary in entry.boundaries:
        chain = a_chain(boundary, n=2, batch=())
        state = a_state(chain)
        trajectory = tc.evolve(chain, state, TIMES, name, **options(name))
        assert difference(trajectory, tc.evolve(chain, state, TIMES, "modes")) < 2 * error(name) * 0.02


@pytest.mark.parametrize(
    ("name", "contact", "damping"),
    [
        (name, contact, damping)
        for name in STEPPED
        for contact in METHODS[name].contacts
        for damping in ((0.0, 0.1) if METHODS[name].damped else (0.0,))
    ],
)
def test_observed_order(name, contact, damping):
    order = int(METHODS[name].order[0])
    chain = a_chain("periodic", contact, damping)
    state, end = a_state(chain), torch.tensor([4.0], dtype=torch.float64)
    expected = reference("periodic", contact, damping)
    expected = tc.Trajectory(end, expected.displacement[:, 4:], expected.velocity[:, 4:])
    errors = [difference(tc.evolve(chain, state, end, name, step=step), expected) for step in (0.05, 0.025)]
    # Runge-Kutta and Adams methods have error terms of the next order, symmetric compositions do not
    window = 0.03 if name in ("verlet", "symplectic4") else 0.2
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=window)


@pytest.mark.parametrize("name", PATHS)
def test_batch_of_two_equals_each_alone(name):
    chain = a_chain(METHODS[name].boundaries[-1])
    state = a_state(chain)
    both = tc.evolve(chain, state, TIMES, name, **options(name))
    for i in range(2):
        one = tc.Chain(chain.masses[i], chain.boundary, chain.contact_stiffness[i])
        alone = tc.evolve(one, tc.State(state.displacement[i], state.velocity[i]), TIMES, name, **options(name))
        pair = tc.Trajectory(TIMES, both.displacement[i], both.velocity[i])
        # an adaptive step is chosen for the batch as a whole
        assert difference(alone, pair) < (error(name) if name in ADAPTIVE else 1e-13) * 0.05


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(
    ("name", "contact", "damping"),
    [("verlet", "linear", 0.0), ("verlet", "linear", 0.3), ("verlet", "hertz", 0.3), ("symplectic4", "hertz", 0.0)],
)
def test_default_steps_do_not_depend_on_the_batch(name, contact, damping, compiled):
    """To the last bit, though the batch holds a chain that takes ten times the steps and a start of thirty times the energy."""
    chain = a_chain("fixed", contact, damping)
    chain = replace(chain, masses=chain.masses * torch.tensor([[1.0], [0.01]], dtype=torch.float64))
    small = a_state(chain, members=(2,))
    size = torch.tensor([1.0, 6.0], dtype=torch.float64)[:, None]
    state = tc.State(size * small.displacement, (size * small.velocity).requires_grad_(not compiled))
    times = TIMES if compiled else TIMES[:3]
    both = tc.evolve(chain, state, times, name)
    for i, j in np.ndindex(2, 2):
        one = tc.Chain(chain.masses[i], "fixed", chain.contact_stiffness[i], contact, chain.contact_damping[i])
        alone = tc.evolve(one, tc.State(state.displacement[i, j], state.velocity[i, j]), times, name)
        assert torch.equal(alone.displacement, both.displacement[i, j])
        assert torch.equal(alone.velocity, both.velocity[i, j])
        if damping:
            assert torch.equal(alone.dissipated, both.dissipated[i, j])
        if contact == "hertz":
            assert torch.equal(alone.openings, both.openings[i, j])


@pytest.mark.parametrize("name", ADAPTIVE)
def test_a_small_start_is_as_accurate_beside_a_large_one(name):
    """The absolute error allowed is a share of each start's own size."""
    chain = a_chain(batch=())
    small = a_state(chain)
    state = tc.State(*(torch.stack([x, 1e-8 * x]) for x in (small.displacement, small.velocity)))
    found = tc.evolve(chain, state, TIMES, name, **options(name))
    assert torch.allclose(1e8 * found.displacement[1], found.displacement[0], rtol=0, atol=0.05 * error(name))
    expected = tc.evolve(chain, small, TIMES, "modes")
    assert (1e8 * found.displacement[1] - expected.displacement).abs().max() < error(name) * 0.05


@pytest.mark.parametrize(("name", "boundary", "contact", "damping"), ONE_BOUNDARY)
def test_inputs_are_not_changed(name, boundary, contact, damping):
    chain = a_chain(boundary, contact, damping)
    state = a_state(chain)
    tensors = [chain.masses, chain.stiffness, chain.damping, state.displacement, state.velocity, TIMES]
    before = [tensor.clone() for tensor in tensors]
    first = tc.evolve(chain, state, TIMES[:3], name, **options(name))
    kept = first.displacement.clone()
    tc.evolve(chain, state, TIMES[:3], name, **options(name))
    assert all(torch.equal(tensor, copy) for tensor, copy in zip(tensors, before, strict=True))
    assert torch.equal(first.displacement, kept)


@pytest.mark.parametrize("name", PATHS)
def test_dtype_and_device_are_kept(name):
    boundary = METHODS[name].boundaries[-1]
    double = a_chain(boundary)
    single = a_chain(boundary, dtype=torch.float32)
    settings = {"rtol": 1e-5 if name == "fehlberg2" else 1e-4} if name in ADAPTIVE else {}
    trajectory = tc.evolve(single, a_state(single), TIMES, name, **settings)
    assert trajectory.displacement.dtype == trajectory.velocity.dtype == torch.float32
    assert trajectory.displacement.device == single.masses.device
    expected = tc.evolve(double, a_state(double), TIMES, name, **settings)
    assert difference(trajectory, expected) < 0.01 * expected.displacement.abs().max()
    assert expected.displacement.dtype == torch.float64


@pytest.mark.parametrize(("name", "boundary", "contact", "damping"), ONE_BOUNDARY)
def test_windows_equal_one_call(name, boundary, contact, damping):
    chain = a_chain(boundary, contact, damping)
    state = a_state(chain)
    whole = tc.evolve(chain, state, TIMES, name, **options(name))
    advance = start(chain, state, name, **options(name))
    pieces = [advance(TIMES[:2]), advance(TIMES[2:4]), advance(TIMES[4:])]
    joined = tc.Trajectory(
        TIMES, torch.cat([p.displacement for p in pieces], -2), torch.cat([p.velocity for p in pieces], -2)
    )
    tolerance = 1e-14 if name in SELF_STARTING else error(name)
    assert difference(whole, joined) < tolerance * (0.3 if contact == "hertz" else 0.03)
    if damping:
        lost = torch.cat([p.dissipated for p in pieces], -1)
        assert (lost - whole.dissipated).abs().max() <= 10 * tolerance * whole.dissipated.max()
    if contact == "hertz":
        assert torch.equal(torch.cat([p.openings for p in pieces], -1), whole.openings)


@pytest.mark.parametrize("name", PATHS)
def test_semigroup(name):
    """From the state at time 2 it goes on as it would have gone."""
    chain = a_chain(METHODS[name].boundaries[-1])
    state, end = a_state(chain), torch.tensor([2.0], dtype=torch.float64)
    halfway = tc.evolve(chain, state, end, name, **options(name)).final
    onward = tc.evolve(chain, halfway, end, name, **options(name))
    direct = tc.evolve(chain, state, 2 * end, name, **options(name))
    assert difference(onward, direct) < max(error(name), 1e-12) * 0.05


@pytest.mark.parametrize(
    ("name", "contact"), [(name, contact) for name in PATHS for contact in METHODS[name].contacts]
)
def test_time_reversal(name, contact):
    chain = a_chain(METHODS[name].boundaries[-1], contact)
    state, end = a_state(chain), torch.tensor([4.0], dtype=torch.float64)
    turned = tc.evolve(chain, state, end, name, **options(name)).final
    back = tc.evolve(chain, tc.State(turned.displacement, -turned.velocity), end, name, **options(name)).final
    reversible = name in EXACT or name in ("verlet", "symplectic4")
    scale = state.displacement.abs().max()
    assert difference(back, tc.State(state.displacement, -state.velocity)) < (
        (1e-11 if reversible else 2 * error(name)) * scale
    )


@pytest.mark.parametrize(
    ("name", "contact", "damping"),
    [
        (name, contact, damping)
        for name in DIFFERENTIABLE
        if name in PATHS
        for contact in METHODS[name].contacts
        for damping in ((0.0, 0.1) if METHODS[name].damped else (0.0,))
    ],
)
def test_gradients(name, contact, damping):
    """Of the state and of the chain, against differences."""
    chain = a_chain("fixed", contact, damping, n=3, batch=())
    state = a_state(chain)
    times = torch.tensor([0.0, 0.7], dtype=torch.float64)
    weights = torch.linspace(-1, 1, 6, dtype=torch.float64)
    settings = {"step": 0.1} if name in STEPPED else options(name)

    def measure(masses, stiffness, damping, displacement, velocity):
        chain_ = replace(chain, masses=masses, stiffness=stiffness, damping=damping)
        final = tc.evolve(chain_, tc.State(displacement, velocity), times, name, **settings).final
        return (torch.cat([final.displacement, final.velocity]) * weights).sum()

    values = [chain.masses, chain.stiffness, chain.damping, state.displacement, state.velocity]
    wanted = [x.clone().requires_grad_(i != 2 or bool(damping)) for i, x in enumerate(values)]
    gradients = torch.autograd.grad(measure(*wanted), [x for x in wanted if x.requires_grad])
    generator = torch.Generator().manual_seed(0)
    for x, gradient in zip([x for x in wanted if x.requires_grad], gradients, strict=True):
        direction = torch.randn(x.shape, generator=generator, dtype=torch.float64)
        ends = [
            measure(*(y.detach() + h * direction if y is x else y.detach() for y in wanted)).item()
            for h in (1e-4, -1e-4)
        ]
        # an adaptive method's steps move with its arguments, which its gradient leaves out
        tolerance = 20 * error(name) * 0.1 / 1e-4 if name in ADAPTIVE else 1e-7
        assert (gradient * direction).sum().item() == pytest.approx((ends[0] - ends[1]) / 2e-4, abs=tolerance)


def test_gradient_of_the_state_through_tridiagonal():
    chain = a_chain("fixed", n=5)
    state = a_state(chain)
    displacement = state.displacement.clone().requires_grad_()
    final = tc.evolve(chain, tc.State(displacement, state.velocity), TIMES, "tridiagonal").final
    (gradient,) = torch.autograd.grad(final.displacement[0, 1], displacement)
    other = state.displacement.clone().requires_grad_()
    final = tc.evolve(chain, tc.State(other, state.velocity), TIMES, "modes").final
    (expected,) = torch.autograd.grad(final.displacement[0, 1], other)
    assert torch.allclose(gradient, expected, atol=1e-13)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("contact", ["linear", "hertz"])
@pytest.mark.parametrize(("composition", "damping"), [(VERLET, 0.0), (VERLET, 0.2), (PEFRL, 0.0)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_compiled_loop_equals_plain_torch(boundary, contact, composition, damping, dtype):
    chain = a_chain(boundary, contact, damping, dtype=dtype)
    state = a_state(chain, amplitude=0.4, members=(3,))
    compiled, plain = (
        march(chain, state, composition, 0.07)(TIMES) for march in (symplectic._rows, symplectic._tensors)
    )
    # rounding grows with the number of steps, faster where contacts open
    assert difference(compiled, plain) < 1000 * torch.finfo(dtype).eps
    if damping:
        assert torch.allclose(compiled.dissipated, plain.dissipated, rtol=100 * torch.finfo(dtype).eps)
    if contact == "hertz":
        assert torch.equal(compiled.openings, plain.openings)
        assert dtype == torch.float32 or compiled.openings.max() > 0


def test_rows_are_shared_among_threads():
    chain = a_chain(batch=(5,))
    state = a_state(chain, members=(2,))
    shared = tc.evolve(chain, state, TIMES, "verlet", step=0.1)
    before = torch.get_num_threads()
    torch.set_num_threads(1 if before > 1 else 3)
    try:
        assert torch.equal(tc.evolve(chain, state, TIMES, "verlet", step=0.1).displacement, shared.displacement)
    finally:
        torch.set_num_threads(before)


# --- stability -------------------------------------------------------------------------------------------------


LIMITED = [("verlet", VERLET), ("symplectic4", PEFRL)]


@pytest.mark.parametrize(("name", "composition"), LIMITED)
@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_edge_of_stability(name, composition, boundary):
    """Bounded at 0.99 of the limit, refused at 1.01, where it does diverge."""
    chain = a_chain(boundary, n=32)
    highest = tc.normal_modes(chain).frequencies.amax()
    step = (composition.limit / highest).item()
    state = a_state(chain)
    times = torch.tensor([1000.0, 2000.0, 4000.0], dtype=torch.float64) * step
    inside = tc.evolve(chain, state, 0.99 * times, name, step=0.99 * step)
    energy = tc.total_energy(chain, inside)
    # the swing of Verlet's energy at 0.99 of its limit is up to 1 / (1 - 0.99^2) = 50
    assert energy.max() < 60 * tc.total_energy(chain, at_start(state)).max()
    assert energy[..., 2].max() < 10 * energy[..., :2].max()
    with pytest.raises(FieldError, match="step must be less than"):
        tc.evolve(chain, state, times, name, step=1.01 * step)
    outside = symplectic.stepping(chain, state, composition, 1.01 * step)(0.3 * times)
    assert outside.displacement[..., 2, :].abs().max() > 1e6


def at_start(state):
    return tc.Trajectory(torch.zeros(1), state.displacement[..., None, :], state.velocity[..., None, :])


def half_trace(composition, y):
    """Half the trace of one step on an oscillator, w h = y, whose modulus passes 1 at the limit."""
    pairs = [composition.opening, *composition.middle, composition.closing]
    step = np.eye(2)
    for drifted, kicked in pairs:
        step = np.array([[1, drifted * y], [0, 1]]) @ step
        step = np.array([[1, 0], [-kicked * y, 1]]) @ step
    return np.trace(step) / 2


@pytest.mark.parametrize("composition", [VERLET, PEFRL])
def test_stated_limit_is_that_of_the_stability_polynomial(composition):
    inside = np.linspace(1e-3, composition.limit, 20001)[:-1]
    assert max(abs(half_trace(composition, y)) for y in inside) < 1
    assert abs(half_trace(composition, composition.limit * 1.0001)) > 1


@pytest.mark.parametrize(("composition", "constant", "order"), [(VERLET, 1 / 24, 2), (PEFRL, 6.05e-5, 4)])
def test_stated_phase_error(composition, constant, order):
    y = 0.2
    phase = np.arccos(half_trace(composition, y))
    assert abs(phase - y) / y ** (order + 1) == pytest.approx(constant, rel=0.02)


@pytest.mark.parametrize("name", ["verlet", "symplectic4"])
@pytest.mark.parametrize("contact", ["linear", "hertz"])
def test_energy_does_not_drift(name, contact):
    """What it is in the last of ten thousand steps it was in the first thousand, to the swing of the energy."""
    chain = a_chain("periodic", contact, n=16)
    state = a_state(chain, amplitude=0.05)
    times = torch.arange(1, 1001, dtype=torch.float64)
    energy = tc.total_energy(chain, tc.evolve(chain, state, times, name, step=0.1 if name == "verlet" else 0.25))
    initial = tc.total_energy(chain, at_start(state))
    deviation = (energy / initial - 1).abs()
    assert deviation[..., :100].max() < 0.02
    assert deviation[..., -100:].max() < 1.5 * deviation[..., :100].max()


@pytest.mark.parametrize("name", ["verlet", "symplectic4"])
def test_momentum_of_a_ring_is_kept(name):
    chain = a_chain("periodic", "hertz", n=16)
    trajectory = tc.evolve(chain, a_state(chain, amplitude=0.2), TIMES, name)
    momentum = (chain.masses[:, None] * trajectory.velocity).sum(-1)
    assert (momentum - momentum[:, :1]).abs().max() < 1e-14


def test_steps_land_on_the_output_times():
    assert symplectic.substeps(0.0, [0.0, 0.1, 0.3, 0.30001, 1.0], 0.1).tolist() == [0, 1, 2, 1, 7]
    assert (symplectic.substeps(0.0, (0.1 * np.arange(1, 1001)).tolist(), 0.1) == 1).all()
    assert symplectic.substeps(0.5, [1.0, 2.0], torch.tensor([0.5, 0.3])).tolist() == [[1, 2], [2, 4]]


@pytest.mark.parametrize("name", [name for name in STEPPED if name not in dict(LIMITED)])
def test_unstable_steps_of_runge_kutta_and_adams_are_caught(name, monkeypatch):
    chain = a_chain(n=16)
    state, times = a_state(chain), torch.tensor([100.0, 400.0], dtype=torch.float64)
    limit = re.search(r"w_max step (?:<|must be less than) ([\d.]+)", METHODS[name].stability)
    step = 0.45
    if limit:
        step = 1.01 * float(limit[1]) / tc.normal_modes(chain).frequencies.amax().item()
        with pytest.raises(FieldError, match="step must be less than"):
            tc.evolve(chain, state, times, name, step=step)
    monkeypatch.setattr("torchchain.evolvers.ode.check_limits", lambda *_: None)
    with pytest.raises(RuntimeError, match=r"energy must stay within 0\.1 of its initial .* use a smaller step"):
        tc.evolve(chain, state, times, name, step=step)


# --- the registry ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", METHODS)
def test_entry_is_complete(name):
    entry = METHODS[name]
    assert entry.name == name
    for fact in ("summary", "order", "conserves", "stability", "cost", "cannot"):
        assert getattr(entry, fact), fact
    accepted = list(inspect.signature(entry.start).parameters)[-len(entry.options) or 99 :]
    assert accepted == list(entry.options)


def message(call) -> str:
    with pytest.raises((ValueError, TypeError)) as raised:
        call()
    return str(raised.value)


def test_refusals_are_one_line_with_rule_and_value():
    ring, rod = a_chain(), a_chain("fixed")
    state = a_state(ring)
    chain_with_gradient = replace(rod, masses=rod.masses.clone().requires_grad_())
    refused = {
        "boundary must be fixed for method 'tridiagonal', got 'periodic'": (ring, "tridiagonal", {}),
        "contact must be linear for method 'damped', got 'hertz'": (a_chain(contact="hertz"), "damped", {}),
        "masses must not require a gradient for method 'tridiagonal'": (chain_with_gradient, "tridiagonal", {}),
        "masses must not require a gradient for method 'lsoda'": (chain_with_gradient, "lsoda", {}),
        "method must be one of modes, .* got 'euler'": (ring, "euler", {}),
        "options of method 'verlet' must have only the keys step, got 'dt'": (ring, "verlet", {"dt": 1}),
        "damping must be zero for method 'symplectic4' (methods with damping: ": (
            a_chain(damping=1),
            "symplectic4",
            {},
        ),
        "step must be a number, got '1'": (ring, "verlet", {"step": "1"}),
        "step must be finite, got inf": (ring, "symplectic4", {"step": float("inf")}),
        "step must be greater than 0, got 0": (ring, "rk4", {"step": 0}),
        "rtol must be at least 8.88178e-16, got -1": (ring, "dopri5", {"rtol": -1}),
        "rtol must be less than 1, got 1": (ring, "lsoda", {"rtol": 1}),
        "atol must be a number, got 'a'": (ring, "dopri8", {"atol": "a"}),
    }
    for expected, (chain, method, extra) in refused.items():
        text = message(lambda c=chain, m=method, e=extra: tc.evolve(c, state, TIMES, m, **e))
        assert re.match(re.escape(expected).replace(r"\.\*", ".*"), text), text
        assert "\n" not in text


@pytest.mark.parametrize(("name", "composition"), LIMITED)
def test_refused_step_names_limit_frequency_and_realization(name, composition):
    chain = tc.Chain(torch.tensor([[1.0, 1.0], [0.25, 0.25]], dtype=torch.float64))
    text = message(lambda: tc.evolve(chain, a_state(chain), TIMES, name, step=1.0))
    limit = composition.limit
    assert text == (
        f"step must be less than {limit / 4:.6g}, the stability limit {limit:.6g} / w_max of method '{name}' "
        "with w_max = 4 at realization 2, got 1.0"
    )


@pytest.mark.parametrize("name", ["verlet", "symplectic4", "dopri5", "rk4"])
def test_a_window_before_the_last_is_refused(name):
    chain = a_chain()
    advance = start(chain, a_state(chain), name)
    advance(TIMES[:3])
    text = message(lambda: advance(TIMES[:3]))
    assert text == "times must continue from 1, the end of the last window, got 0.0"
    assert advance(TIMES[2:4]).times[0] == 1.0
