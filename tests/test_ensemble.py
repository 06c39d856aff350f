import tomllib
from dataclasses import replace

import literal
import numpy as np
import pytest
import torch
import xarray

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.ensemble import observables
from torchchain.ensemble.layout import layout
from torchchain.ensemble.run import stream
from torchchain.ensemble.scene_words import describe
from torchchain.ensemble.stages import Stages

OBSERVABLES = [name for name, entry in observables.OBSERVABLES.items() if "chain" in entry.kinds]
TIMES = [0.0, 0.7, 5.0, 90.0]


def reference(scene, i):
    """All observables of realization i of a scene, for every tone, by the literal equations."""
    n = scene.n_particles
    masses = scene.disorder.masses(n, [i], scene.seed)[0].numpy()
    stiffness = np.ones(n + (scene.boundary == "fixed"))
    if scene.stiffness_disorder is not None:
        stiffness = scene.stiffness_disorder.stiffnesses(len(stiffness), [i], scene.seed)[0].numpy()
    matrix = literal.stiffness_matrix(stiffness, n, scene.boundary)
    particle = np.arange(1, n + 1)
    if scene.tones:
        starts = [(0.01 * np.sin(2 * np.pi * tone * particle / n), np.zeros(n)) for tone in scene.tones]
    else:
        starts = [(np.zeros(n), scene.excitation.velocity * (particle == scene.excitation.site))]
    found = {name: [] for name in OBSERVABLES}
    for u0, v0 in starts:
        rows = {name: [] for name in OBSERVABLES}
        for u, v in zip(*literal.states(masses, matrix, u0, v0, scene.times.numpy()), strict=True):
            # A ring's displacement counts from where its motion as a whole has taken it.
            rest = u - (masses * u).sum() / masses.sum() if scene.boundary == "periodic" else u
            total = np.diag(masses) @ np.outer(v, v) / 2 - matrix @ np.outer(rest, rest) / 2
            energy = np.diag(total)
            center = (particle * energy).sum() / energy.sum()
            rows["displacement"].append(u)
            rows["energy"].append(energy)
            rows["dissipated"].append(0.0)  # linear contacts without damping: nothing is lost, none is open
            rows["openings"].append(0.0)
            rows["source_energy"].append(energy[getattr(scene.excitation, "site", 1) - 1])
            rows["total_energy"].append(energy.sum())
            rows["center"].append(center)
            rows["width"].append(((particle - center) ** 2 * energy).sum() / energy.sum())
            rows["wavenumber_energy"].append(literal.wavenumber_energy(total).real)
            rows["band_energy"].append(literal.band_energy(masses, matrix, u, v, scene.n_bands))
        for u, v in zip(*literal.states(masses, matrix, v0, u0, scene.times.numpy()), strict=True):
            if scene.tones:  # the wave as a velocity
                rows["kicked_band_energy"].append(literal.band_energy(masses, matrix, u, v, scene.n_bands))
        for name, row in rows.items():
            found[name].append(np.array(row))
        found["long_time_band_energy"][-1] = literal.long_time_band_energy(masses, matrix, u0, v0, scene.n_bands)
    return {name: np.array(values) if scene.tones else values[0] for name, values in found.items()}


COMMON = {
    "n_particles": 16,
    "n_bands": 4,
    "realizations": 5,
    "seed": 3,
    "times": TIMES,
    "observables": tuple(OBSERVABLES),
}


@pytest.mark.parametrize(
    "fields",
    [
        {"excitation": tc.StandingWave((1, 3, 6))},
        {"excitation": tc.Impulse(6, 0.02)},
        {"excitation": tc.Impulse(1), "boundary": "fixed"},
        {"excitation": tc.StandingWave((5,)), "stiffness_disorder": tc.Disorder("gamma", 0.2)},
    ],
    ids=["waves", "kick", "wall", "stiffness"],
)
def test_means_and_errors_of_all_observables(fields):
    kicked = isinstance(fields["excitation"], tc.Impulse)
    names = [name for name in OBSERVABLES if not (kicked and name == "kicked_band_energy")]
    scene = tc.Scene(**COMMON | {"observables": names}, **fields)
    data = tc.simulate(scene, "modes")
    single = [reference(scene, i) for i in range(5)]
    for name in names:
        values = np.stack([found[name] for found in single])
        scale = abs(values).max()
        # The literal frequencies are good for a phase of 1e-12 at t = 90; the center weighs energies by 16.
        np.testing.assert_allclose(data[name].values, values.mean(0), rtol=0, atol=1e-10 * scale)
        error = values.std(0, ddof=1) / np.sqrt(5)
        np.testing.assert_allclose(data[f"{name}_stderr"].values, error, rtol=0, atol=1e-10 * scale)
    masses = scene.disorder.masses(16, 5, 3).numpy()
    assert data.attrs["mass_mean"] == pytest.approx(masses.mean(), rel=1e-14)
    assert data.attrs["mass_sd"] == pytest.approx(masses.std(), rel=1e-12)


def test_labels_and_units():
    data = tc.simulate(tc.Scene(**COMMON), "modes")
    assert data["energy"].dims == ("tone", "time", "particle")
    assert data["band_energy"].dims == ("tone", "time", "band")
    assert data["long_time_band_energy"].dims == ("tone", "band")
    assert data["tone"].values.tolist() == [1, 3, 5, 7]
    assert data["particle"].values.tolist() == list(range(1, 17))
    assert data["band"].values.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(data["wavenumber"].values, np.arange(9) * np.pi / 8)
    np.testing.assert_array_equal(data["time"].values, TIMES)
    assert all("units" in data[name].attrs and "long_name" in data[name].attrs for name in OBSERVABLES)
    assert tc.Scene.from_dict(tomllib.loads(data.attrs["scene"])).to_dict() == tc.Scene(**COMMON).to_dict()


def test_bond_definition_reaches_every_observable():
    scene = tc.Scene(**COMMON, energy_definition="bond")
    data = tc.simulate(scene, "modes")
    assert (data["energy"].values >= 0).all()
    assert (data["wavenumber_energy"].values >= 0).all()
    chain = scene.chain(range(5))
    late = tc.long_time_band_energy(chain, scene.state(chain), 4, definition="bond").mean(0)
    np.testing.assert_allclose(data["long_time_band_energy"].values, late.numpy(), rtol=1e-12)
    site = tc.simulate(replace(scene, energy_definition="site"), "modes")
    assert abs(site["long_time_band_energy"] - data["long_time_band_energy"]).max() > 1e-3


def equal(a, b):
    return all(np.array_equal(a[name].values, b[name].values) for name in a.data_vars)


@pytest.mark.parametrize("budget", [1, 2**17, 2**20, 2**23])
def test_memory_budget_changes_no_bit(budget):
    scene = tc.Scene(**{**COMMON, "realizations": 11})
    assert equal(tc.simulate(scene, "modes"), tc.simulate(scene, "modes", memory_budget=budget))


@pytest.mark.parametrize("method", ["modes", "chebyshev"])
def test_what_is_multiplied_together_depends_on_the_scene_alone(method):
    scene = tc.Scene(**{**COMMON, "realizations": 50})
    whole = layout(scene, method, torch.device("cpu"))
    for realizations, budget in ((50, 1), (3, None), (1, 2**20)):
        assert whole.chunks(realizations, budget).size % whole.group == 0


def test_large_states_come_in_windows_of_times():
    scene = tc.Scene(n_particles=2**15, n_bands=1, realizations=2, times=np.arange(20.0), observables=("energy",))
    assert 1 < layout(scene, "chebyshev", torch.device("cpu")).window < 20


@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet"])
def test_threads_change_no_bit(threads, method, small_scene):
    options = {"step": 0.05} if method == "verlet" else None
    one = tc.band_transfer(small_scene, method, options=options)
    torch.set_num_threads(threads)
    try:
        other = tc.band_transfer(small_scene, method, options=options)
        assert torch.get_num_threads() == threads  # what the caller has set is set again
    finally:
        torch.set_num_threads(1)
    for name in ("mean", "stderr", "long_time", "long_time_stderr", "block_mean"):
        assert torch.equal(getattr(other, name), getattr(one, name))


@pytest.mark.parametrize("cuts", [[0, 12], [0, 5, 12], [0, 1, 2, 3, 12]])
@pytest.mark.parametrize("names", [("band_energy", "long_time_band_energy"), ("center", "width")])
def test_chunks_of_the_stencil_change_no_bit(cuts, names, small_scene):
    scene = replace(small_scene, observables=names)
    numbers = [range(a, b) for a, b in zip(cuts, cuts[1:], strict=False)]

    def measure(chunk):
        return chunk.observe(names)

    whole = [m for _, m in stream(scene, measure, "chebyshev", options={"accuracy": 1e-10})]
    parts = [m for _, m in stream(scene, measure, "chebyshev", options={"accuracy": 1e-10}, numbers=numbers)]
    for name in whole[0]:
        assert torch.equal(torch.cat([m[name] for m in whole]), torch.cat([m[name] for m in parts]))


PAIRED = {
    "n_particles": 16, "n_bands": 4, "realizations": 14, "seed": 3, "times": TIMES, "opposite_pairs": True,
    "observables": ("band_energy", "width"), "stiffness_disorder": tc.Disorder("gamma", 0.2),
}  # fmt: skip


@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet"])
def test_opposite_pairs_are_one_sample_each(method):
    scene = tc.Scene(**PAIRED)
    data = tc.simulate(scene, method, options={"step": 1e-3} if method == "verlet" else None)
    chain = scene.chain(range(14))
    trajectory = tc.evolve(chain, scene.state(chain), scene.times, "modes")
    energy = tc.particle_energy(chain, trajectory)
    every = {"band_energy": tc.band_energy(chain, trajectory, 4), "width": tc.energy_width(energy)}
    for name, values in every.items():
        pairs = values.numpy().reshape(7, 2, *values.shape[1:]).mean(1)
        scale = abs(pairs).max()
        near = {"rtol": 0, "atol": (1e-4 if method == "verlet" else 1e-10) * scale}
        np.testing.assert_allclose(data[name].values, pairs.mean(0), **near)
        np.testing.assert_allclose(data[f"{name}_stderr"].values, pairs.std(0, ddof=1) / np.sqrt(7), **near)
    assert data.attrs["mass_mean"] == pytest.approx(chain.masses.mean().item(), rel=1e-14)


@pytest.mark.parametrize("budget", [1, 2**17, 2**20])
@pytest.mark.parametrize("method", ["modes", "chebyshev"])
def test_pairs_in_any_chunks_give_the_same_bits(budget, method):
    scene = tc.Scene(**PAIRED)
    assert layout(scene, method, torch.device("cpu")).group % 2 == 0
    assert equal(tc.simulate(scene, method), tc.simulate(scene, method, memory_budget=budget))


def test_pairs_in_a_transfer():
    scene = tc.Scene(**{**PAIRED, "stiffness_disorder": None})
    pairs = tc.band_transfer(scene, "modes")
    assert pairs.block_counts == (1,) * 7
    chain = scene.chain([4, 5])
    trajectory = tc.evolve(chain, scene.state(chain), scene.times, "modes")
    expected = tc.band_energy(chain, trajectory, 4).mean(0)
    assert torch.allclose(pairs.block_mean[2], expected, rtol=0, atol=1e-12)


def test_pairs_take_far_fewer_chains_for_a_width():
    """The squared width of a kick in the center: what is odd in the masses cancels in a pair."""
    scene = tc.Scene(
        200, "fixed", excitation=tc.Impulse(100), times=[40.0], realizations=200, observables=("width",), seed=1
    )
    plain, pairs = tc.simulate(scene), tc.simulate(replace(scene, opposite_pairs=True))
    error, smaller = plain.width_stderr.item(), pairs.width_stderr.item()
    assert smaller < 0.5 * error  # a quarter of the chains; measured 0.32
    assert abs(plain.width.item() - pairs.width.item()) < 4 * np.hypot(error, smaller)


def test_pairs_need_an_even_number():
    with pytest.raises(FieldError, match="realizations must be even for opposite_pairs, got 5"):
        tc.Scene(realizations=5, opposite_pairs=True)
    assert "14 periodic chains in opposite pairs, N = 16" in describe(tc.Scene(**PAIRED))
    with pytest.raises(FieldTypeError, match="opposite_pairs must be True or False"):
        tc.Scene(opposite_pairs=1)
    ordered = tc.Scene(**{**COMMON, "disorder": tc.Disorder(strength=0)}, opposite_pairs=True)
    assert (tc.simulate(ordered, "modes")["band_energy_stderr"].values == 0).all()


def test_a_run_repeats_to_the_last_bit():
    scene = tc.Scene(**COMMON)
    assert equal(tc.simulate(scene, "modes"), tc.simulate(scene, "modes"))


def test_more_realizations_begin_with_the_same_ones():
    scene = tc.Scene(**COMMON)
    five = tc.simulate(scene, "modes")["band_energy"].values
    six = tc.simulate(replace(scene, realizations=6), "modes")["band_energy"].values
    last = reference(scene, 5)["band_energy"]
    np.testing.assert_allclose(6 * six - 5 * five, last, atol=1e-9)


def test_one_realization_has_an_infinite_error():
    data = tc.simulate(tc.Scene(**{**COMMON, "realizations": 1}), "modes")
    for name in OBSERVABLES:
        assert np.isposinf(data[f"{name}_stderr"].values).all()
        assert np.isfinite(data[name].values).all()
    one = tc.band_transfer(tc.Scene(**{**COMMON, "realizations": 1}), "modes")
    assert torch.isposinf(one.stderr).all()
    assert torch.isposinf(one.long_time_stderr).all()


def test_an_ordered_scene_has_no_error_and_is_computed_once():
    scene = tc.Scene(**{**COMMON, "realizations": 10**6}, disorder=tc.Disorder(strength=0.0))
    data = tc.simulate(scene, "modes")
    for name in OBSERVABLES:
        assert not data[f"{name}_stderr"].values.any()
    np.testing.assert_allclose(data["band_energy"].values, np.eye(4)[:, None].repeat(4, 1), atol=1e-12)
    assert (data.attrs["mass_mean"], data.attrs["mass_sd"]) == (1.0, 0.0)


def test_band_transfer_is_the_simulation_of_one_tone_a_band():
    scene = tc.Scene(**{**COMMON, "observables": ("band_energy", "long_time_band_energy")})
    data, transfer = tc.simulate(scene, "modes"), tc.band_transfer(scene, "modes")
    assert transfer.mean.shape == transfer.stderr.shape == (4, 4, 4)
    for ours, theirs in (
        (transfer.mean, "band_energy"),
        (transfer.stderr, "band_energy_stderr"),
        (transfer.long_time, "long_time_band_energy"),
        (transfer.long_time_stderr, "long_time_band_energy_stderr"),
    ):
        np.testing.assert_allclose(ours.numpy(), data[theirs].values, rtol=1e-12, atol=1e-15)
    assert torch.equal(transfer.times, scene.times)
    assert transfer.n_bands == 4
    assert transfer.scene.tones == (1, 3, 5, 7)


def test_band_transfer_conserves_energy(small_transfer):
    # Standing waves have no net momentum, but k = 0 holds some of a disordered chain's energy (M v is not uniform).
    rest = 1 - small_transfer.mean.sum(-1)
    assert abs(rest[:, 0]).max() < 1e-14
    assert abs(rest).max() < 0.05
    starts = small_transfer.mean[:, 0]
    assert torch.allclose(starts, torch.eye(4, dtype=torch.float64), atol=1e-13)


def test_blocks(small_transfer):
    counts = torch.tensor(small_transfer.block_counts, dtype=torch.float64)
    assert counts.sum() == 12
    weights = counts / counts.sum()
    for blocks, whole in (
        (small_transfer.block_mean, small_transfer.mean),
        (small_transfer.block_long_time, small_transfer.long_time),
    ):
        assert torch.allclose(torch.einsum("b...,b->...", blocks, weights), whole, rtol=1e-12, atol=1e-15)
    many = tc.band_transfer(tc.Scene(**{**COMMON, "realizations": 47}), "modes", long_time=False)
    assert len(many.block_counts) == 20
    assert sum(many.block_counts) == 47
    assert {2, 3} == set(many.block_counts)


@pytest.mark.parametrize("long_time", [True, False])
def test_transfers_are_saved_and_read_back(long_time, tmp_path):
    scene = tc.Scene(**{**COMMON, "times": [0.0, 0.3, 1.7]}, energy_definition="bond")
    transfer = tc.band_transfer(scene, "modes", long_time)
    assert (transfer.long_time is None) is (not long_time)
    path = tmp_path / "transfer.nc"
    transfer.to_dataset().to_netcdf(path, engine="h5netcdf")
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        again = tc.BandTransfer.from_dataset(data)
    assert again.scene.to_dict() == transfer.scene.to_dict()
    assert again.block_counts == transfer.block_counts
    assert again.attributes == transfer.attributes
    for name in ("times", "mean", "stderr", "long_time", "long_time_stderr", "block_mean", "block_long_time"):
        ours, theirs = getattr(transfer, name), getattr(again, name)
        assert ours is theirs is None or torch.equal(ours, theirs)


def test_source_and_receiver_are_not_exchanged(small_transfer):
    # The ensemble's T is far from symmetric: a literal chain by chain mean tells row from column.
    scene = small_transfer.scene
    single = np.stack([reference(scene, i)["band_energy"][:, -1] for i in range(3)]).mean(0)
    three = tc.band_transfer(replace(scene, realizations=3), "modes")
    np.testing.assert_allclose(three.mean[:, -1].numpy(), single, atol=1e-10)
    assert abs(single - single.T).max() > 0.01


# Infinite-time shares [source, receiver] at the paper's case: the mean over 1200 chains drawn by NumPy's own generator
# (normal, redrawn below 0.05) with scipy.linalg.eigh, np.fft and the sum over modes; standard errors below 0.4 %.
KNOWN = {(23, 23): 0.1121, (23, 20): 0.0570, (20, 20): 0.1534, (20, 23): 0.0539, (10, 10): 0.563}


def test_known_steady_states():
    scene = tc.Scene(realizations=30, times=[0.0], seed=1)
    transfer = tc.band_transfer(scene, "modes")
    for (source, receiver), expected in KNOWN.items():
        at = source - 1, receiver - 1
        error = transfer.long_time_stderr[at].item()
        assert abs(transfer.long_time[at].item() - expected) < 4 * error
        assert error < 0.1 * expected  # else the line above would say little


def test_stages_are_timed():
    stages = Stages()
    tc.band_transfer(tc.Scene(**COMMON), "modes", stages=stages)
    assert {"masses", "eigen-decomposition", "long-time average", "statistics"} <= set(stages.seconds)
    assert all(seconds >= 0 for seconds in stages.seconds.values())


BASE = tc.Scene(**COMMON)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: tc.band_transfer(replace(BASE, excitation=tc.Impulse())),
            FieldError,
            "excitation must be standing waves for a band transfer, got Impulse",
        ),
        (
            lambda: tc.band_transfer(replace(BASE, excitation=tc.StandingWave((1, 3, 5)))),
            FieldError,
            r"excitation.tones must lie one in each of the 4 bands, in order, got bands \[1, 2, 3\]",
        ),
        (
            lambda: tc.band_transfer(replace(BASE, excitation=tc.StandingWave((1, 2, 5, 7)))),
            FieldError,
            "excitation.tones must lie one in each of the 4 bands",
        ),
        (
            lambda: tc.band_transfer(replace(BASE, excitation=tc.StandingWave((3, 1, 5, 7)))),
            FieldError,
            "excitation.tones must lie one in each of the 4 bands, in order",
        ),
        (lambda: tc.simulate(BASE, "mode"), FieldError, "method must be one of .*, got 'mode'"),
        (lambda: tc.band_transfer(BASE, "theroy"), FieldError, "method must be one of .*, theory, got .*; did you mean theory"),
        (lambda: tc.simulate(BASE, None), FieldTypeError, "method must be a string"),
        (lambda: tc.simulate(BASE, "modes", memory_budget=0), FieldError, "memory_budget must be at least 1"),
        (lambda: tc.simulate(BASE, "modes", memory_budget=1.5), FieldTypeError, "memory_budget must be an integer"),
        (lambda: tc.simulate(BASE, "modes", options={"foo": 1}), FieldError, "options of method 'modes' must have"),
        (
            lambda: tc.simulate(replace(BASE, damping=0.1, observables=("energy",)), "modes"),
            FieldError,
            "damping must be zero",
        ),
        (
            lambda: tc.simulate(replace(BASE, contact="hertz", observables=("energy",)), "modes"),
            FieldError,
            "contact must be linear for method 'modes'",
        ),
    ],
)
def test_bad_arguments(call, error, message):
    with pytest.raises(error, match=message):
        call()
