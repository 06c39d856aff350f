"""A chain in a batch is the chain alone: same numbers, same precision, its own errors, and nothing given is changed."""

import copy
import dataclasses
import warnings

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.chain.amplitude import LinearityWarning
from torchchain.checks import FieldError
from torchchain.evolvers import METHODS
from torchchain.evolvers.energy_guard import EnergyDriftError

TIMES = torch.tensor([0.0, 0.4, 1.0, 3.0], dtype=torch.float64)
BITWISE = ("chebyshev", "verlet", "symplectic4")
N, B = 16, 4


def batch(boundary="periodic", contact="linear", damping=0.0, size=5, dtype=torch.float64):
    """Chains of different masses and contacts, the third of them three times lighter than the others."""
    generator = torch.Generator().manual_seed(11)
    masses = 0.6 + 0.8 * torch.rand(size, N, generator=generator, dtype=torch.float64)
    masses[2 % size] /= 3
    stiffness = 0.8 + 0.4 * torch.rand(size, N + (boundary == "fixed"), generator=generator, dtype=torch.float64)
    return tc.Chain(masses.to(dtype), boundary, stiffness.to(dtype), contact, damping)


def starts(chain, members=(2,)):
    """Random starts, two for each chain, of very different sizes."""
    generator = torch.Generator().manual_seed(12)
    shape = (*chain.batch_shape, *members, chain.n_particles)
    size = torch.logspace(-6, -2, chain.batch_shape.numel(), dtype=torch.float64).reshape(*chain.batch_shape, 1, 1)
    parts = [size * torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(2)]
    return tc.State(*(part.to(chain.masses.dtype) for part in parts))


def alone(chain, i):
    """Chain i as a batch of its own, and as no batch at all."""
    return (
        dataclasses.replace(chain, masses=chain.masses[i : i + 1], stiffness=chain.stiffness[i : i + 1], damping=chain.damping),
        dataclasses.replace(chain, masses=chain.masses[i], stiffness=chain.stiffness[i], damping=chain.damping),
    )  # fmt: skip


def part(state, i):
    return (
        tc.State(state.displacement[i : i + 1], state.velocity[i : i + 1]),
        tc.State(state.displacement[i], state.velocity[i]),
    )


def same(one, other, bitwise, tolerance=1e-12):
    """Equal, or equal to the tolerance of the largest number."""
    assert one.shape == other.shape
    if bitwise:
        assert torch.equal(one, other)
    else:
        assert float((one - other).abs().max()) <= tolerance * float(other.abs().max())


CASES = [
    (name, boundary, contact, damping)
    for name, entry in METHODS.items()
    for boundary in entry.boundaries
    for contact in entry.contacts
    for damping in ((0.0, 0.1) if entry.damped else (0.0,))
    if name not in {"adaptive_heun", "fehlberg2", "bosh3", "midpoint", "heun2", "heun3"}  # like the rest of their kind
]


def adaptive(name):
    return "rtol" in METHODS[name].options


@pytest.mark.parametrize(("name", "boundary", "contact", "damping"), [c for c in CASES if not adaptive(c[0])])
def test_a_chain_alone_equals_the_same_in_a_batch(name, boundary, contact, damping):
    """To rounding, and by the stencil's kernels to the last bit; adaptive methods choose their steps for all."""
    chain = batch(boundary, contact, damping)
    state = starts(chain)
    options = {"step": 0.05} if "step" in METHODS[name].options else {}
    together = tc.evolve(chain, state, TIMES, name, **options)
    for i in (0, 2, 4):
        for single, begin, kept in zip(alone(chain, i), part(state, i), (slice(i, i + 1), i), strict=True):
            found = tc.evolve(single, begin, TIMES, name, **options)
            for field in ("displacement", "velocity"):
                same(getattr(found, field), getattr(together, field)[kept], name in BITWISE)
            if damping:
                same(found.dissipated, together.dissipated[kept], name in BITWISE)
            if contact == "hertz":
                assert torch.equal(found.openings, together.openings[kept])


@pytest.mark.parametrize("order", [[4, 3, 2, 1, 0], [2, 2, 2, 0, 1, 2, 3], [0]])
@pytest.mark.parametrize("name", BITWISE)
def test_neighbors_in_the_batch_do_not_matter(name, order):
    chain = batch()
    state = starts(chain)
    whole = tc.evolve(chain, state, TIMES, name)
    mixed = tc.evolve(
        tc.Chain(chain.masses[order], "periodic", chain.stiffness[order]),
        tc.State(state.displacement[order], state.velocity[order]),
        TIMES,
        name,
    )
    assert torch.equal(mixed.displacement, whole.displacement[order])
    assert torch.equal(mixed.velocity, whole.velocity[order])


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("definition", ["site", "bond"])
def test_fused_observables_of_a_chain_alone(boundary, definition):
    from torchchain.ensemble import fused

    chain = batch(boundary)
    state = starts(chain)
    moments = tc.energy_moments(chain, state, TIMES, definition)
    shares = (
        None
        if (boundary, definition) == ("fixed", "bond")
        else fused.band_energy(chain, state, TIMES, B, True, definition)
    )
    for i in range(5):
        for single, begin, kept in zip(alone(chain, i), part(state, i), (slice(i, i + 1), i), strict=True):
            found = tc.energy_moments(single, begin, TIMES, definition)
            for field in ("total", "center", "width"):
                assert torch.equal(getattr(found, field), getattr(moments, field)[kept])
            if shares is not None:
                assert torch.equal(fused.band_energy(single, begin, TIMES, B, True, definition), shares[kept])


@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet"])
def test_a_realization_alone_is_that_of_the_ensemble(method):
    """The chain of number i, whatever else is drawn with it."""
    scene = tc.Scene(n_particles=N, n_bands=B, realizations=6, times=TIMES, seed=3)
    every = scene.chain(range(6))
    for i in (0, 5, 3):
        one = scene.chain([i])
        assert torch.equal(one.masses[0], every.masses[i])
        same(
            tc.evolve(one, scene.state(one), TIMES, method).displacement[0],
            tc.evolve(every, scene.state(every), TIMES, method).displacement[i],
            method in BITWISE,
        )


@pytest.fixture(scope="module")
def transfer():
    scene = tc.Scene(n_particles=N, n_bands=B, realizations=8, times=np.arange(0, 8.01, 0.5), seed=3)
    return tc.band_transfer(scene, "modes")


@pytest.fixture(scope="module")
def masters(transfer):
    return {
        "markov": tc.calibrate(transfer, "linear", "basis_matrix", bootstrap=2),
        "swing_in": tc.calibrate(transfer, "linear", "swing_in", bootstrap=2),
        "memory": tc.calibrate(transfer, "projection", order=(1, 1), bootstrap=2),
    }


@pytest.mark.filterwarnings("ignore::torchchain.master.equation.PredictionWarning")
@pytest.mark.parametrize("kind", ["markov", "swing_in", "memory"])
@pytest.mark.parametrize("method", ["expm", "dopri8", "rk4", "implicit_adams"])
def test_a_start_alone_equals_the_same_in_a_batch(masters, kind, method):
    """Of very different sizes; an adaptive method's steps, an implicit one's iterations are those of its worst member."""
    master = masters[kind]
    rows = torch.eye(B, dtype=torch.float64) * torch.logspace(-3, 3, B, dtype=torch.float64)[:, None]
    iterated = method in ("dopri8", "implicit_adams")
    options = {"rtol": 1e-12, "atol": 1e-16} if iterated else {}
    together = master.solve(rows, TIMES, method, **options).detach()
    tolerance = 1e-10 if iterated else 1e-12
    for i, row in enumerate(rows):
        same(master.solve(row, TIMES, method, **options).detach(), together[i], False, tolerance)
    fed = master.solve(rows, TIMES, supply=rows / 10).detach() if method == "expm" else None
    if fed is None:
        errors = master.standard_error(rows, TIMES)
        for row, error in zip(rows, errors, strict=True):
            same(master.standard_error(row, TIMES), error, False)


# Nothing that is given is changed


def values(x):
    """All tensors in something, by the way to them."""
    if isinstance(x, torch.Tensor):
        return {"": x}
    if isinstance(x, torch.nn.Module):
        return dict(x.state_dict())
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        return {
            f"{entry.name}.{way}": value
            for entry in dataclasses.fields(x)
            for way, value in values(getattr(x, entry.name)).items()
        }
    if isinstance(x, (list, tuple)):
        return {f"{i}.{way}": value for i, entry in enumerate(x) for way, value in values(entry).items()}
    return {}


def calls(transfer, masters):
    """Every public function that takes tensors, with its arguments."""
    chain, family = batch(), None
    state = starts(chain)
    path = tc.evolve(chain, state, TIMES)
    modes = tc.normal_modes(chain)
    energy = tc.particle_energy(chain, path, "bond")
    rows = torch.eye(B, dtype=torch.float64)
    single = {name: value.detach() for name, value in masters["memory"].model.tensors().items()}
    yield "Chain", tc.Chain, (chain.masses, "periodic", chain.stiffness, "linear", chain.damping)
    yield "State", tc.State, (state.displacement, state.velocity)
    for name in METHODS:
        if "periodic" in METHODS[name].boundaries:
            yield f"evolve {name}", lambda c, s, t, name=name: tc.evolve(c, s, t, name), (chain, state, TIMES)
    hertz, rod = batch(contact="hertz"), batch("fixed")
    for name in ("verlet", "symplectic4", "dopri5", "rk4"):
        yield f"evolve {name} hertz", lambda c, s, t, name=name: tc.evolve(c, s, t, name), (hertz, starts(hertz), TIMES)
    yield "evolve tridiagonal", lambda c, s, t: tc.evolve(c, s, t, "tridiagonal"), (rod, starts(rod), TIMES)
    yield "evolve with modes", lambda c, s, t, m: tc.evolve(c, s, t, modes=m), (chain, state, TIMES, modes)
    yield (
        "evolve bound",
        lambda c, s, t, b: tc.evolve(c, s, t, "chebyshev", bound=b),
        (chain, state, TIMES, torch.full((5,), 60.0)),
    )
    for function in (tc.normal_modes, tc.impulse, tc.standing_wave):
        yield function.__name__, function, (chain,)
    for function in (
        tc.kinetic_energy,
        tc.potential_energy,
        tc.particle_energy,
        tc.total_energy,
        tc.energy_matrices,
        tc.wavenumber_energy,
        tc.zero_wavenumber_share,
        tc.linearity,
    ):
        yield function.__name__, function, (chain, path)
    for definition in ("site", "bond"):
        yield f"band_energy {definition}", tc.band_energy, (chain, path, B, True, definition)
        yield f"potential_energy {definition}", tc.potential_energy, (chain, path, definition)
        yield f"energy_moments {definition}", tc.energy_moments, (chain, state, TIMES, definition)
        yield (
            f"long_time_band_energy {definition}",
            tc.long_time_band_energy,
            (chain, state, B, True, modes, definition),
        )
    yield "potential_energy rod", tc.potential_energy, (rod, tc.evolve(rod, starts(rod), TIMES), "bond")
    yield "wavenumber_energy_matrix", tc.wavenumber_energy_matrix, (tc.energy_matrices(chain, path),)
    yield "energy_center", tc.energy_center, (energy,)
    yield "energy_width", tc.energy_width, (energy,)
    yield "bin_energy", tc.bin_energy, (energy[..., :9].clone(), B)
    yield "count_modes_below", tc.count_modes_below, (chain, TIMES)
    yield "lyapunov_exponent", lambda w: tc.lyapunov_exponent(tc.Disorder(), w, 16, 2), (TIMES,)
    yield "integrated_density_of_states", lambda w: tc.integrated_density_of_states(tc.Disorder(), w, 16, 2), (TIMES,)
    yield "weak_disorder_lyapunov", tc.weak_disorder_lyapunov, (0.3, TIMES / 2)
    yield "total_variation", tc.total_variation, (rows, rows / 2)
    yield "statistical_distance", tc.statistical_distance, (rows,)
    yield "Scene", lambda t: tc.simulate(tc.Scene(n_particles=N, n_bands=B, realizations=2, times=t), "modes"), (TIMES,)
    for name, settings in {
        "linear": {},
        "nonlinear": {},
        "analytic": {},
        "adam": {"steps": 3},
        "projection": {"order": (1, 0)},
    }.items():
        yield (
            f"calibrate {name}",
            lambda t, name=name, settings=settings: tc.calibrate(t, name, **settings),
            (transfer,),
        )
    yield "calibrate", lambda t: tc.calibrate(t, order=(1, 0), bootstrap=2), (transfer,)
    yield "chapman_kolmogorov", lambda t: tc.chapman_kolmogorov(t, 0.5), (transfer,)
    yield "implied_timescales", tc.implied_timescales, (transfer, torch.tensor([0.5, 1.0]))
    yield "RateModel", tc.RateModel, (0 * rows, rows, 0 * rows[0])
    yield "SwingInModel", tc.SwingInModel, (0 * rows, rows, rows[0] + 1, 0 * rows[0])
    yield "MemoryModel", lambda *given: tc.MemoryModel(**dict(zip(single, given, strict=True))), tuple(single.values())
    for kind, master in masters.items():
        for method in ("expm", "dopri5", "rk4"):
            yield (
                f"solve {kind} {method}",
                lambda m, e, t, s, method=method: m.solve(e, t, method, supply=s),
                (master, rows, TIMES, rows[0]),
            )
        yield f"standard_error {kind}", lambda m, e, t: m.standard_error(e, t), (master, rows, TIMES)
        yield f"dissipated {kind}", lambda m, e, t: m.dissipated(e, t), (master, rows, TIMES)
    yield "coarsened", lambda m: m.coarsened(2), (masters["memory"],)
    other = dataclasses.replace(transfer, scene=dataclasses.replace(transfer.scene, disorder=tc.Disorder(strength=0.2)))
    yield "calibrate_family", lambda a, b: tc.calibrate_family([a, b], order=(1, 0), bootstrap=0), (transfer, other)
    family = tc.calibrate_family([transfer, other], order=(1, 0), bootstrap=2)
    yield (
        "family",
        lambda e, t, *members: tc.MasterFamily(list(members)).solve(e, t, 0.25),
        (rows, TIMES, *family.members),
    )


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_nothing_that_is_given_is_changed(transfer, masters):
    count = 0
    for name, function, arguments in calls(transfer, masters):
        before = copy.deepcopy([value.detach().clone() for value in values(list(arguments)).values()])
        assert before or name == "Scene", name
        function(*arguments)
        for (way, now), then in zip(values(list(arguments)).items(), before, strict=True):
            assert torch.equal(now.detach(), then), f"{name} changed {way}"
        count += 1
    assert count > 70


# Precision and device are those of what is given


PRECISE = {
    "masses": lambda c, s, p: c.contact_stiffness,
    "impulse": lambda c, s, p: tc.impulse(c).velocity,
    "standing_wave": lambda c, s, p: tc.standing_wave(c).displacement,
    "frequencies": lambda c, s, p: tc.normal_modes(c).frequencies,
    "shapes": lambda c, s, p: tc.normal_modes(c).shapes,
    "kinetic": lambda c, s, p: tc.kinetic_energy(c, p),
    "site": lambda c, s, p: tc.potential_energy(c, p, "site"),
    "bond": lambda c, s, p: tc.potential_energy(c, p, "bond"),
    "particle": lambda c, s, p: tc.particle_energy(c, p),
    "total": lambda c, s, p: tc.total_energy(c, p),
    "matrices": lambda c, s, p: tc.energy_matrices(c, p).total,
    "center": lambda c, s, p: tc.energy_center(tc.particle_energy(c, p, "bond")),
    "width": lambda c, s, p: tc.energy_width(tc.particle_energy(c, p, "bond")),
    "wavenumber": lambda c, s, p: tc.wavenumber_energy(c, p),
    "wavenumber by bonds": lambda c, s, p: tc.wavenumber_energy(c, p, "bond"),
    "bands": lambda c, s, p: tc.band_energy(c, p, B),
    "share of k = 0": lambda c, s, p: tc.zero_wavenumber_share(c, p),
    "at infinite time": lambda c, s, p: tc.long_time_band_energy(c, s, B),
    "at infinite time by bonds": lambda c, s, p: tc.long_time_band_energy(c, s, B, definition="bond"),
    "moments": lambda c, s, p: tc.energy_moments(c, s, TIMES).width,
    "elongation": lambda c, s, p: tc.linearity(c, s).force_deviation,
    "total variation": lambda c, s, p: tc.total_variation(p.displacement, p.velocity),
    "statistical distance": lambda c, s, p: tc.statistical_distance(p.displacement.abs()),
}


@pytest.mark.parametrize("what", PRECISE)
def test_single_precision_in_single_precision_out(what):
    """And the same numbers as in double precision, to the digits that it has."""
    found = {}
    for dtype in (torch.float32, torch.float64):
        chain = batch(dtype=dtype)
        state = tc.standing_wave(chain, (1, 3))
        path = tc.evolve(chain, state, TIMES, "verlet", step=0.05)
        found[dtype] = PRECISE[what](chain, state, path)
        assert found[dtype].dtype == dtype
        assert found[dtype].device == chain.masses.device
    if what == "shapes":  # their signs are anyone's
        found = {dtype: value.abs() for dtype, value in found.items()}
    one, other = found[torch.float32].double(), found[torch.float64]
    scale = 1.0 if "share" in what else float(other.abs().max())
    assert float((one - other).abs().max()) <= 2e-4 * scale


@pytest.mark.parametrize("kind", ["markov", "swing_in", "memory"])
@pytest.mark.filterwarnings("ignore::torchchain.master.equation.PredictionWarning")
def test_a_model_in_single_precision(masters, kind):
    single = copy.deepcopy(masters[kind]).float()
    for method in ("expm", "dopri5", "rk4"):
        found = single.solve(torch.eye(B), TIMES, method)
        assert found.dtype == torch.float32
        assert torch.allclose(found.double(), masters[kind].solve(np.eye(B), TIMES, method), atol=1e-5)
    assert single.standard_error(torch.eye(B), TIMES).dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("what", PRECISE)
def test_the_gpu_agrees_and_keeps_its_results(what):
    found = {}
    for device in ("cpu", "cuda"):
        plain = batch()
        chain = tc.Chain(plain.masses.to(device), "periodic", plain.stiffness.to(device))
        state = tc.standing_wave(chain, (1, 3))
        path = tc.evolve(chain, state, TIMES.to(device), "verlet", step=0.05)
        found[device] = PRECISE[what](chain, state, path)
        assert found[device].device.type == device
    if what == "shapes":
        found = {device: value.abs() for device, value in found.items()}
    torch.testing.assert_close(found["cuda"].cpu(), found["cpu"], rtol=1e-9, atol=1e-11)


# One bad chain is named, and the others are as they were


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("masses", float("nan"), "masses must be finite, got nan at realization 4, particle 7"),
        ("masses", -0.25, "masses must be positive, got -0.25 at realization 4, particle 7"),
        ("masses", 0.0, "masses must be positive, got 0 at realization 4, particle 7"),
        ("stiffness", float("inf"), "stiffness must be finite, got inf at realization 4, "),
        ("stiffness", -1.0, "stiffness must be positive, got -1 at realization 4, contact 7"),
    ],
)
def test_a_bad_chain_is_named(field, value, message):
    chain = batch()
    given = {"masses": chain.masses.clone(), "stiffness": chain.stiffness.clone()}
    given[field][3, 6] = value
    with pytest.raises(FieldError) as caught:
        tc.Chain(**given)
    assert str(caught.value).startswith(
        message.replace(
            "masses must be finite, got nan at realization 4, particle 7",
            "masses must be finite, got nan at realization 4, ",
        )
    )


@pytest.mark.parametrize("name", ["verlet", "symplectic4", "rk4", "heun3"])
def test_the_chain_that_a_step_is_too_large_for_is_named(name):
    chain = batch()
    light = torch.cat([chain.masses[:1], chain.masses[1:2], chain.masses[2:3] / 100, chain.masses[3:]])
    with pytest.raises(
        FieldError, match=r"step must be less than .*, the stability limit .* at realization 3, got 0.3"
    ):
        tc.evolve(tc.Chain(light), starts(chain), TIMES, name, step=0.3)
    rest = [0, 1, 3, 4]
    state = starts(chain)
    good = tc.State(state.displacement[rest], state.velocity[rest])
    assert torch.isfinite(tc.evolve(tc.Chain(light[rest]), good, TIMES, name, step=0.3).displacement).all()


def test_the_start_that_diverges_is_named_by_the_energy():
    """A Hertz chain stiffens as it is pressed, so that a step which is stable at the start is not later."""
    chain = batch("fixed", "hertz")
    velocity = torch.zeros(5, N, dtype=torch.float64)
    velocity[:, 0] = 0.01
    velocity[3, 0] = 1e4
    with pytest.raises(EnergyDriftError, match="energy must stay within .* realization 4 "):
        tc.evolve(chain, tc.State(0 * velocity, velocity), [5.0], "verlet", step=0.2)


def test_the_state_without_energy_is_named():
    chain = batch()
    state = starts(chain)
    still = torch.ones(5, 2, 1, dtype=torch.float64)
    still[1, 1] = 0
    state = tc.State(still * state.displacement, still * state.velocity)
    for call in (
        lambda: tc.energy_center(tc.particle_energy(chain, tc.evolve(chain, state, TIMES), "bond")),
        lambda: tc.band_energy(chain, tc.evolve(chain, state, TIMES), B),
        lambda: tc.long_time_band_energy(chain, state, B),
        lambda: tc.energy_moments(chain, state, TIMES),
    ):
        with pytest.raises(FieldError, match=r"total energy must be positive.*, got 0 at realization 2.*2"):
            call()


def test_the_start_too_large_for_linear_contacts_is_named():
    chain = batch()
    state = starts(chain)
    large = torch.ones(5, 1, 1, dtype=torch.float64)
    large[1] = 1e6
    with pytest.warns(LinearityWarning, match="at realization 2, "):
        together = tc.evolve(chain, tc.State(large * state.displacement, large * state.velocity), TIMES, "chebyshev")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = tc.evolve(chain, state, TIMES, "chebyshev")
    others = [0, 2, 3, 4]
    assert torch.equal(together.displacement[others], expected.displacement[others])
