"""Any start: kicks from releases, energies by tone, the transfer of other starts, its model, and predictions against chains."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray

import torchchain as tc
from torchchain import energy
from torchchain.checks import FieldError, FieldTypeError
from torchchain.energy import StartEnergy
from torchchain.ensemble.fused import band_energy
from torchchain.ensemble.starts import start_tones
from torchchain.master.compact import n_coefficients
from torchchain.master.equation import PredictionWarning
from torchchain.master.logistic import RIDGE, solve
from torchchain.master.starts import StartModel
from torchchain.master.tones import ToneRegression, Tones, shares

N, B = 64, 8
TIMES = torch.tensor([0.0, 0.5, 3.0, 20.0], dtype=torch.float64)


def scene(**changes):
    times = [*np.arange(0, 5, 0.25), *np.arange(5, 60.1, 1.0)]
    return tc.Scene(**{"n_particles": N, "n_bands": B, "realizations": 120, "times": times} | changes)


@pytest.fixture(scope="module")
def transfer():
    return tc.band_transfer(scene(), "chebyshev")


@pytest.fixture(scope="module")
def master(transfer):
    return tc.calibrate(transfer)


def disordered(boundary="periodic", stiffness=1.0, count=3):
    if stiffness is None:
        stiffness = tc.Disorder(strength=0.3).masses(N + (boundary == "fixed"), count, seed=9)
    return tc.Chain(tc.Disorder(strength=0.3).masses(N, count, seed=5), boundary=boundary, stiffness=stiffness)


@pytest.mark.parametrize("stiffness", [1.0, 2.5, None])
@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_a_kick_follows_from_a_release(boundary, stiffness):
    chain = disordered(boundary, stiffness)
    wave = tc.standing_wave(chain, tone=[2, 13])
    kick = tc.State(torch.zeros_like(wave.displacement), wave.displacement)
    released, direct = (tc.evolve(chain, start, TIMES, method="modes") for start in (wave, kick))
    path = energy.kicked(chain, released)
    still = chain.without_rigid_motion(direct.displacement)
    assert torch.equal(path.velocity, released.displacement)
    torch.testing.assert_close(path.velocity, direct.velocity, rtol=0, atol=1e-14)
    torch.testing.assert_close(path.displacement, still, rtol=0, atol=1e-12)
    for definition in ("site", "bond") if boundary == "periodic" else ("site",):
        found = energy.kicked_band_energy(chain, released, B, definition=definition)
        wanted = tc.band_energy(chain, direct, B, definition=definition)
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)


def test_kicks_need_linear_undamped_contacts():
    for chain in (replace(disordered(), contact="hertz"), replace(disordered(), damping=0.1)):
        path = tc.evolve(disordered(), tc.standing_wave(chain, tone=2), TIMES, method="modes")
        with pytest.raises(FieldError, match=r"contact must be 'linear'|damping must be 0"):
            energy.kicked_band_energy(chain, path, B)
    with pytest.raises(FieldError, match="excitation must be standing waves at rest"):
        tc.simulate(scene(excitation=tc.Impulse(), realizations=2, observables=("kicked_band_energy",)), "modes")


def test_a_half_way_start_is_the_derivative_of_a_kick():
    """Of every chain, not on average: the cross term of (u, v = w u) is the slope of the energy after the kick, over w."""
    chain = disordered()
    wave, step = tc.standing_wave(chain, tone=13).displacement, 1e-4
    zero = torch.zeros_like(wave)

    def bands(start, times):
        return tc.band_energy(chain, tc.evolve(chain, start, times, method="modes"), B, normalize=False)

    cross = bands(tc.State(wave, wave), TIMES[1:]) - bands(tc.State(wave, zero), TIMES[1:]) - bands(tc.State(zero, wave), TIMES[1:])
    slope = (bands(tc.State(zero, wave), TIMES[1:] + step) - bands(tc.State(zero, wave), TIMES[1:] - step)) / (2 * step)
    torch.testing.assert_close(cross, slope, rtol=0, atol=1e-6 * float(slope.abs().max()))


def test_start_energies_add_up():
    chain, draw = disordered(), torch.Generator().manual_seed(0)
    state = tc.State(*torch.randn(2, 3, 4, N, generator=draw, dtype=torch.float64))
    start = tc.start_energy(chain, state)
    path = tc.Trajectory(torch.zeros(1), state.displacement[..., None, :], state.velocity[..., None, :])
    torch.testing.assert_close(start.total, tc.total_energy(chain, path)[..., 0])
    torch.testing.assert_close(start.bands(B).sum(-1) + start.rigid, start.total)
    assert start.potential.shape == (3, 4, N // 2)
    assert start.n_particles == N
    ordered = tc.Chain(torch.ones(N, dtype=torch.float64))
    start = tc.start_energy(ordered, state)
    torch.testing.assert_close(start.bands(B), tc.band_energy(ordered, path, B, normalize=False)[..., 0, :])


def test_kinds_of_starts():
    chain = tc.Chain(torch.ones(N, dtype=torch.float64))
    place = torch.arange(1, N + 1, dtype=torch.float64)
    k = 2 * np.pi * 5 / N
    w, wave = 2 * np.sin(k / 2), torch.sin(k * place)
    parts = {
        "released": tc.State(wave, 0 * wave), "kicked": tc.State(0 * wave, w * wave), "half way": tc.State(wave, w * wave),
        "traveling": tc.State(wave, -w * torch.cos(k * place)),
    }  # fmt: skip
    found = {name: tc.start_energy(chain, state) for name, state in parts.items()}
    one = N * w**2 / 4
    for name, (potential, kinetic, virial) in {
        "released": (1, 0, 0), "kicked": (0, 1, 0), "half way": (1, 1, 1 / w), "traveling": (1, 1, 0),
    }.items():  # fmt: skip
        numbers = [float(getattr(found[name], part)[4]) / one for part in ("potential", "kinetic", "virial")]
        assert numbers == pytest.approx([potential, kinetic, virial * 1], abs=1e-12), name
        assert float(found[name].bands(B)[1]) == pytest.approx((potential + kinetic) * one)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda c: tc.start_energy(disordered("fixed"), tc.standing_wave(disordered("fixed"), 2)), "ring of an even number"),
        (lambda c: tc.start_energy(replace(c, contact="hertz"), tc.standing_wave(c, 2)), "contact must be 'linear'"),
        (lambda c: tc.start_energy(c, tc.State(*torch.zeros(2, 3, N))), "state must have energy"),
        (lambda c: StartEnergy(*torch.ones(3, 4), torch.ones(2)), r"rigid must have shape \(\)"),
        (lambda c: StartEnergy(-torch.ones(4), *torch.ones(2, 4), torch.tensor(0.0)), "potential must not be negative"),
        (lambda c: energy.excited(tc.Impulse(site=N + 1), N), "excitation.site must be"),
    ],
)
def test_bad_starts(build, message):
    with pytest.raises(FieldError, match=message):
        build(disordered())


def test_other_starts_are_those_of_the_chains(transfer):
    starts = transfer.starts
    assert starts.tones == tuple(range(2, 33, 2)) == start_tones(transfer.scene)
    assert starts.samples == 120
    assert starts.times[0] == 0
    assert starts.times[-1] == transfer.times[-1]
    chain = transfer.scene.chain(range(120))
    wave = tc.standing_wave(chain, starts.tones, phase="cos").displacement
    for kind, state in {"released": tc.State(wave, 0 * wave), "kicked": tc.State(0 * wave, wave)}.items():
        direct = tc.band_energy(chain, tc.evolve(chain, state, starts.times, method="chebyshev"), B)
        stderr = direct.std(0) / np.sqrt(120)
        off = (getattr(starts, kind) - direct.mean(0)).abs()
        assert bool((off <= stderr / 8 + 1e-7).all())  # half of the unit of rounding, a quarter of the noise
        held = getattr(starts, f"{kind}_stderr")
        torch.testing.assert_close(held, stderr, rtol=2.0**-4, atol=1e-10)


def test_other_starts_do_not_depend_on_the_cut_and_leave_the_rest_as_it_is(transfer, tmp_path):
    alone = tc.band_transfer(transfer.scene, "chebyshev", starts=False)
    assert alone.starts is None
    assert torch.equal(alone.mean, transfer.mean)
    checkpoint = tc.Checkpoint(tmp_path / "kept", every=0)
    cut = tc.band_transfer(transfer.scene, "chebyshev", memory_budget=1, checkpoint=checkpoint)
    again = tc.band_transfer(transfer.scene, "chebyshev", checkpoint=checkpoint)
    cut.save(tmp_path / "transfer.nc")
    for other in (cut.starts, again.starts, tc.BandTransfer.load(tmp_path / "transfer.nc").starts):
        assert (other.tones, other.samples) == (transfer.starts.tones, transfer.starts.samples)
        for name in ("times", "released", "released_stderr", "kicked", "kicked_stderr"):
            assert torch.equal(getattr(other, name), getattr(transfer.starts, name)), name
    checkpoint.clear()
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"boundary": "fixed"}, {"damping": 0.1}, {"realizations": 15}, {"energy_definition": "bond"},
        {"lattice": "square", "shape": (8, 8)},
    ],
)
def test_where_other_starts_are_not_measured(changes):
    small = {"n_particles": 16, "n_bands": 4, "realizations": 16, "times": [0.0, 1.0]} | changes
    if "lattice" in changes:
        del small["n_particles"]
    assert tc.band_transfer(tc.Scene(**small)).starts is None


def test_one_tone_a_band_and_opposite_pairs():
    small = scene(n_particles=16, n_bands=8, realizations=32, opposite_pairs=True, excitation=tc.StandingWave(phase="cos"))
    found = tc.band_transfer(small, "modes").starts
    assert found.tones == tuple(range(1, 9))
    assert found.samples == 16


def test_bad_starts_of_a_transfer(transfer):
    good = transfer.starts
    for changes, message in (
        ({"tones": good.tones[::-1]}, "starts.tones must increase"),
        ({"released": good.released[:3]}, "starts.released must have the axes"),
        ({"kicked_stderr": -good.kicked_stderr}, "starts.kicked_stderr must not be negative"),
        ({"samples": 0}, "starts.samples must be"),
    ):
        with pytest.raises(FieldError, match=message):
            replace(good, **changes)
    other = replace(good, **{name: getattr(good, name)[..., :3] for name in ("released", "released_stderr", "kicked", "kicked_stderr")})
    with pytest.raises(FieldError, match="starts must have 8 receivers"):
        replace(transfer, starts=other)
    data = transfer.to_dataset()
    with pytest.raises(FieldError, match="data must hold the variable kicked"):
        tc.BandTransfer.from_dataset(data.drop_vars("kicked"))
    with pytest.raises(FieldTypeError, match=r"data.released must be of float32 or float64"):
        tc.BandTransfer.from_dataset(data.assign(released=data.released.astype(int)))


def random_model(seed=0, degrees=(4, 3, 6)):
    draw, tones = np.random.default_rng(seed), Tones.of(N, B, 0.3)
    numbers = [torch.from_numpy(draw.normal(0, 0.5, n_coefficients(degrees))) for _ in range(2)]
    none = torch.zeros(0, dtype=torch.float64)
    return StartModel(torch.tensor(degrees).double(), *numbers, tones.frequency, tones.decay, tones.coupling, none, none.expand(2, 2, 0), B)


@pytest.mark.parametrize("seed", range(3))
def test_any_coefficients_make_shares_of_an_energy(seed):
    model = random_model(seed)
    times = torch.cat([torch.zeros(1), torch.logspace(-3, 6, 60)]).double()
    for kind, power in (("released", 4), ("kicked", 2)):
        found = model.transfer(kind, range(1, N // 2 + 1), times)
        assert float(found.min()) >= 0
        torch.testing.assert_close(found.sum(-1), torch.ones(N // 2, len(times), dtype=torch.float64), rtol=0, atol=1e-13)
        eye = torch.eye(B, dtype=torch.float64).repeat_interleave(N // 2 // B, 0)
        torch.testing.assert_close(found[:, 0], eye, rtol=0, atol=1e-15)
        moved = model.transfer(kind, [6], torch.tensor([1e-7, 2e-7]).double())[0] @ (1 - eye[5])
        assert float(moved[1] / moved[0]) == pytest.approx(2.0**power, rel=0.01)


def test_coefficients_are_recovered():
    model = random_model(7)
    numbers, times = torch.arange(0, N // 2, 2), torch.logspace(-0.5, 2, 24).double()
    tones = Tones.of(N, B, 0.3)
    for kind in ("released", "kicked"):
        data = shares(tones, kind, model.degrees, getattr(model, kind), numbers, times)
        problem = ToneRegression(tones, kind, model.degrees, numbers, times, data, torch.full(data.shape[:2], 1e6).double())
        found, report = solve([problem], np.ones((1, 1)))
        _, slots = problem.misfit(problem.table(found[0]))
        assert report["converged"]
        assert float((torch.from_numpy(problem._bands(slots)) - data).abs().max()) < 1e-5


def test_derivatives_of_the_regression():
    model, tones = random_model(3), Tones.of(N, B, 0.3)
    numbers, times = torch.tensor([1, 6, 30]), torch.tensor([1.0, 9.0]).double()
    data, weight = torch.rand(3, 2, B, generator=torch.Generator().manual_seed(1)).double(), torch.ones(3, 2).double()
    problem = ToneRegression(tones, "kicked", model.degrees, numbers, times, data, weight)
    here = model.kicked.numpy()
    _, slots = problem.misfit(problem.table(here))
    _, pull = problem.normal(slots, problem.table(here))
    for i in (0, 5, len(here) - 1):
        moved = [here.copy() for _ in range(2)]
        moved[0][i] += 1e-5
        moved[1][i] -= 1e-5
        up, down = (problem.misfit(problem.table(x))[0] for x in moved)
        assert -(up - down) / 4e-5 == pytest.approx(pull[i], rel=1e-5, abs=1e-8)
    found = []
    for sign in (1, -1):
        each = (problem.misfit(problem.table(here + sign * step))[1] for step in 1e-5 * np.eye(len(here)))
        found.append(np.stack([problem._bands(slots) for slots in each]))
    slopes = (found[0] - found[1]) / 2e-5
    matrix, _ = problem.normal(slots, problem.table(here))
    expected = np.einsum("astr,bstr->ab", slopes, slopes) + RIDGE * np.eye(len(here))
    assert abs(matrix - expected).max() < 1e-8 * expected.max()


def fresh(start, times, count=160, seed=77):
    """Mean energies of fresh chains over their mean total, (start, time, band), and the noise of two such ensembles."""
    chain = tc.Chain(tc.Disorder(strength=0.3).masses(N, range(count), seed))
    here = tc.State(*(x.expand(count, *x.shape) for x in (start.displacement, start.velocity)))
    found = band_energy(chain, here, times, B, normalize=False)
    total = tc.start_energy(chain, here).total.mean(0)[:, None, None]
    return found.mean(0) / total, tc.statistical_distance(found.std(0) / total / np.sqrt(count))


def starts():
    """One start of every kind, displacement and velocity (start, particle)."""
    place = torch.arange(1, N + 1, dtype=torch.float64)
    draw = torch.Generator().manual_seed(4)
    bead, wave = torch.zeros(N, dtype=torch.float64), {n: torch.sin(2 * np.pi * n / N * place) for n in (13, 14, 24, 28)}
    bead[9] = 1.0
    w = {n: 2 * np.sin(np.pi * n / N) for n in wave}
    envelope = torch.exp(-((place - 30) ** 2) / 40)
    packet = envelope * wave[14], -w[14] * envelope * torch.cos(2 * np.pi * 14 / N * place)
    pairs = [
        (wave[14], 0 * bead), (wave[13], 0 * bead), (wave[24], 0 * bead), (0 * bead, wave[14]), (0 * bead, wave[28]),
        (wave[14], -w[14] * torch.cos(2 * np.pi * 14 / N * place)), packet, (0 * bead, bead), (bead, 0 * bead), (wave[24], w[24] * wave[24]),
        tuple(torch.randn(2, N, generator=draw, dtype=torch.float64)),
    ]  # fmt: skip
    return tc.State(*(torch.stack(parts) for parts in zip(*pairs, strict=True)))


def test_any_start_is_foretold_as_well_as_by_another_ensemble(master):
    times = torch.tensor([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0], dtype=torch.float64)
    given = starts()
    start = tc.start_energy(tc.Chain(torch.ones(N, dtype=torch.float64)), given)
    several = [fresh(given, times, seed=seed) for seed in (77, 78, 79)]
    measured, noise = several[0]
    size = start.total[:, None, None]
    told, error = master.solve(start, times) / size, master.standard_error(start, times) / size
    off = tc.total_variation(told, measured)
    ratio = torch.stack([tc.total_variation(told, x)[:, 1:].mean(1) / y[:, 1:].mean(1) for x, y in several]).mean(0)
    assert float(ratio.max()) < 1.6, ratio  # two ensembles of one start scatter by a quarter
    assert float(ratio.mean()) < 1.1, ratio
    whole = told.sum(-1) + (start.rigid / start.total)[:, None]
    kicks = (start.kinetic.sum(-1) / start.total)[:, None]
    lost = master.starts.lost(start, times) / start.total[:, None]
    torch.testing.assert_close(whole + lost, torch.ones(11, 9).double(), rtol=0, atol=1e-12)
    assert bool((whole <= 1 + 1e-12).all())
    assert float((1 - whole - 2 * 0.3**2 / N * kicks).max()) < 0.3**2 / N  # the derivative of what is lost is in it
    inside = ((told - measured).abs() <= (error.square() + (noise[..., None] / B).square()).sqrt()).double()
    assert 0.5 < float(inside[:, 1:].mean()) < 0.95
    plain = tc.total_variation(master.solve(start.bands(B), times) / size, measured)
    worst = [2, 3, 4]  # an edge tone and two kicks, of which energies of bands tell nothing
    assert float((plain[worst, 1:].mean(1) / off[worst, 1:].mean(1)).min()) > 1.5


def test_a_wave_that_moves_towards_rest_has_energies_below_zero_by_site_as_chains_have(master):
    """Energies by site are no squares: of moving chains a band far off can hold less than none, and the model says so."""
    n, times = 29, [0.1, 0.3, 0.5]
    chain = tc.Chain(tc.Disorder().masses(N, 2000, seed=3))
    place = torch.sin(2 * np.pi * n / N * torch.arange(N, dtype=torch.float64))
    ahead = tc.State(1e-3 * place.expand(2000, N), -1e-3 * 2 * np.sin(np.pi * n / N) * place.expand(2000, N))
    energies = tc.band_energy(chain, tc.evolve(chain, ahead, times), B, normalize=False)
    whole = energies.sum(-1).mean(0)[:, None]
    mean, error = energies.mean(0) / whole, energies.std(0) / whole / 2000**0.5
    others = torch.arange(B) != (n - 1) // (N // 2 // B)
    assert bool((mean < -4 * error)[:2, others].all())  # measured -0.0015 to -0.0030 with errors of 0.00004
    even = tc.Chain(torch.ones(N, dtype=torch.float64))
    with pytest.warns(PredictionWarning, match="chains on their way to rest have such energies as well"):
        found = master.solve(tc.start_energy(even, tc.State(ahead.displacement[0], ahead.velocity[0])), times)
    found = found / found.sum(-1, keepdim=True)
    torch.testing.assert_close(found[:, others], mean[:, others], rtol=0.15, atol=3e-4)
    assert float(found.min()) < -1e-3


def test_the_error_of_a_virial_is_the_change_of_that_of_a_kick(master):
    zero, one = torch.zeros(N // 2, dtype=torch.float64), torch.zeros(N // 2, dtype=torch.float64)
    one[13] = 1.0
    none = torch.zeros(()).double()
    kick, virial, both = (StartEnergy(zero, k, g, none) for k, g in ((one, zero), (zero, one), (one, one)))
    times = torch.tensor([0.7, 3.0, 11.0], dtype=torch.float64)
    before, here, after = (master.standard_error(kick, share * times) for share in (0.8, 1.0, 1.2))
    slope = (after - before) / (0.4 * times[:, None])
    assert float(slope.abs().max()) > 0
    torch.testing.assert_close(master.standard_error(virial, times), slope.abs())
    torch.testing.assert_close(master.standard_error(both, times), (here + slope).abs())


def test_starts_by_name(master):
    times = [0.0, 5.0]
    one = master.solve(tc.Impulse(site=5), times)
    assert one.shape == (2, B)
    kick = tc.start_energy(tc.Chain(torch.ones(N).double()), tc.impulse(tc.Chain(torch.ones(N).double()), site=40))
    torch.testing.assert_close(one, master.solve(kick, times))
    assert master.solve(tc.StandingWave(), times).shape == (B, 2, B)
    assert master.standard_error(tc.StandingWave(tones=(3,)), times).shape == (1, 2, B)


def test_the_file_holds_both_transfers(master, tmp_path):
    master.save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert again.starts.n_parameters == master.starts.n_parameters > 0
    for start in (tc.Impulse(), tc.StandingWave(tones=(3, 4))):
        assert torch.equal(again.solve(start, [1.0, 9.0]), master.solve(start, [1.0, 9.0]))
        assert torch.equal(again.standard_error(start, [1.0, 9.0]), master.standard_error(start, [1.0, 9.0]))
    again.float()
    assert again.starts.released.dtype == torch.float64
    assert again.solve(tc.Impulse(), [1.0]).dtype == torch.float32


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("starts.decay", None, "must hold the tensors"),
        ("starts.decay", torch.zeros(32), "starts.decay must be positive"),
        ("starts.released", torch.ones(5).double(), "starts.released must have shape"),
        ("starts.frequency", torch.ones(31).double(), "starts.decay must have shape"),
        ("starts.scale", torch.full((2, 2, 24), -1.0), "starts.scale must hold factors"),
        ("starts.stderr", torch.ones(2, 8, 3, 8), "starts.stderr must have shape"),
        ("starts.stderr", torch.full((2, 8, 24, 8), -1.0), "starts.stderr must not be negative"),
        ("starts.kicked", torch.full((10,), torch.nan).double(), "starts.kicked must"),
    ],
)
def test_damaged_files(name, value, message, master, tmp_path):
    from safetensors import safe_open
    from safetensors.torch import save_file

    master.save(tmp_path / "q.safetensors")
    with safe_open(tmp_path / "q.safetensors", "pt") as file:
        header, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    tensors = {key: tensor for key, tensor in {**tensors, name: value}.items() if tensor is not None}
    save_file(tensors, tmp_path / "bad.safetensors", header)
    with pytest.raises(FieldError, match=message):
        tc.MasterEquation.load(tmp_path / "bad.safetensors")


def test_what_starts_in_space_cannot_do(master, transfer):
    other = energy.excited(tc.Impulse(), 32)
    with pytest.raises(FieldError, match=f"initial must be a start on {N} particles"):
        master.solve(other, [1.0])
    with pytest.raises(FieldError, match="method for a start in space must be"):
        master.solve(tc.Impulse(), [1.0], "dopri8")
    with pytest.raises(FieldError, match="supply must be None for a start in space"):
        master.solve(tc.Impulse(), [1.0], supply=np.ones(B))
    plain = tc.calibrate(replace(transfer, starts=None))
    assert plain.starts is None
    with pytest.warns(tc.PredictionWarning, match="calibrated without other starts"):
        found = plain.solve(tc.Impulse(), [1.0])
    torch.testing.assert_close(found, plain.solve(energy.excited(tc.Impulse(), N).bands(B), [1.0]))


def test_concerns_and_plan_know_that_any_start_will_do(master, transfer):
    for excitation in (tc.Impulse(3), tc.StandingWave(tones=(3, 31))):
        there = scene(excitation=excitation)
        assert master.concerns(there) == []
        assert tc.calibrate(replace(transfer, starts=None)).concerns(there) != []
    assert "covers the scene" in str(tc.plan(scene(excitation=tc.Impulse(3)), artifact=master))


def test_predict_takes_starts_in_space(master, tmp_path, monkeypatch, capsys):
    from torchchain.cli import main

    monkeypatch.chdir(tmp_path)
    master.save("q.safetensors")
    times = ["--times.stop", "10", "--times.step", "5"]
    assert main(["predict", "q.safetensors", "--excitation.kind", "impulse", *times, "--out", "a"]) == 0
    assert "energy at k = 0, which stays there and is in no band: 0.015" in capsys.readouterr().out
    with xarray.open_dataset("a/results.nc", engine="h5netcdf") as data:
        start = energy.excited(tc.Impulse(), N)
        wanted = master.solve(start, [0.0, 5.0, 10.0]) / start.total
        np.testing.assert_allclose(data.band_energy[0], wanted, rtol=1e-9)
    (tmp_path / "kick.toml").write_text(f"[state]\nvelocity = {[1.0] + [0.0] * (N - 1)}\n")
    for request in ("kick.toml", "a/config.toml"):
        assert main(["predict", "q.safetensors", "--config", request, *times, "--out", "b"]) == 0
        with xarray.open_dataset("b/results.nc", engine="h5netcdf") as data:
            np.testing.assert_allclose(data.band_energy[0], wanted, rtol=1e-9)
    assert main(["predict", "q.safetensors", "--excitation.tones", "3", "5", *times, "--out", "c"]) == 0
    with xarray.open_dataset("c/results.nc", engine="h5netcdf") as data:
        assert data.start.values.tolist() == ["tone 3", "tone 5"]
        np.testing.assert_allclose(data.band_energy[:, 0].sum("band"), 1.0)
    capsys.readouterr()
    for arguments, message in (
        (["--config", "kick.toml", "--source", "3"], "source must not be given together with state"),
        (["--excitation.kind", "impulse", "--excitation.site", "99"], "excitation.site must be"),
    ):
        assert main(["predict", "q.safetensors", *arguments, "--out", "d"]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "kick.toml").write_text("[state]\nvelocity = [1.0, 0.0]\n")
    assert main(["predict", "q.safetensors", "--config", "kick.toml", "--out", "d"]) == 2
    assert f"state.velocity must hold the {N} particles" in capsys.readouterr().err


def test_a_kick_leaves_energy_at_zero_wavenumber():
    """Of random masses it is (variance / N) (1 - cos(w t) exp(-g t)), against kicked chains."""
    times, count = torch.tensor([0.0, 2.0, 7.0, 25.0, 60.0], dtype=torch.float64), 2000
    chain = tc.Chain(tc.Disorder(strength=0.3).masses(N, range(count), 6))
    tones = torch.tensor([1, 5, 12])
    wave = torch.sin(2 * np.pi * tones[:, None] / N * torch.arange(N)).double().expand(count, 3, N)
    energy = band_energy(chain, tc.State(0 * wave, wave), times, B, normalize=False).sum(-1)
    gone = 1 - energy / energy[..., :1]
    mean, error = gone.mean(0), gone.std(0) / np.sqrt(count)
    told = Tones.of(N, B, 0.3, 0.3).lost(tones - 1, times)
    assert float(told.max()) < 0.3**2 / N * 2
    assert bool(((mean - told).abs() <= 4 * error + 0.15 * 0.3**2 / N).all())


def test_perturbation_theory_is_left_alone_where_little_is_scattered():
    """At long waves the model is that of no coefficients, whatever these are."""
    times = torch.tensor([3.0, 30.0, 300.0], dtype=torch.float64)
    model = random_model(2)
    tones = Tones.of(N, B, 0.02)
    changed, plain = (
        StartModel(**model.tensors() | {"coupling": tones.coupling, "onset": tones.onset, "released": c}, n_bands=B)
        for c in (model.released, 0 * model.released)
    )
    for tone, alike in ((1, True), (28, False)):
        found, known = (m.transfer("released", [tone], times)[0] for m in (changed, plain))
        assert torch.allclose(found, known, rtol=0, atol=2e-6) is alike


def test_files_without_the_later_tensors_are_read(master, tmp_path):
    from safetensors import safe_open
    from safetensors.torch import save_file

    master.save(tmp_path / "new.safetensors")
    with safe_open(tmp_path / "new.safetensors", "pt") as file:
        header, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    older = {name: value for name, value in tensors.items() if name not in ("starts.rigid", "starts.onset", "starts.stderr")}
    save_file(older, tmp_path / "old.safetensors", header)
    starts = tc.MasterEquation.load(tmp_path / "old.safetensors").starts
    assert float(starts.rigid) == float(starts.onset) == 0
    assert starts.stderr.shape == (2, B, 0, B)
    old, new = (tc.MasterEquation.load(tmp_path / f"{name}.safetensors").standard_error(tc.Impulse(), [1.0, 9.0]) for name in ("old", "new"))
    assert 0.2 < float((old / new).mean()) < 5
    torch.testing.assert_close(starts.transfer("kicked", [1, 9], TIMES).sum(-1), torch.ones(2, 4).double(), rtol=0, atol=1e-12)
    save_file(tensors | {"starts.rigid": torch.tensor(-0.1).double()}, tmp_path / "bad.safetensors", header)
    with pytest.raises(FieldError, match="starts.rigid must be a share of the energy"):
        tc.MasterEquation.load(tmp_path / "bad.safetensors")


def test_the_command_measures_starts_or_not(tmp_path, monkeypatch, capsys):
    from torchchain.cli import main

    monkeypatch.chdir(tmp_path)
    small = ["--n-particles", "16", "--n-bands", "2", "--realizations", "16", "--times.stop", "4", *"--fit linear --model paper --bootstrap 0".split()]
    assert main(["calibrate", *small, "--starts", "False", "--out", "bands"]) == 0
    assert "starts = false" in Path("bands/config.toml").read_text()
    assert tc.MasterEquation.load("bands/model.safetensors").starts is None
    assert main(["calibrate", *small, "--out", "any"]) == 0
    assert tc.MasterEquation.load("any/model.safetensors").starts is not None
    seconds = [tc.open(run).record["forecast"].get("predicted_seconds") for run in ("bands", "any")]
    assert None in seconds or seconds[1] > seconds[0]  # a method that no plan weighs has no forecast
    capsys.readouterr()


def test_a_family_takes_any_start_between_its_members_and_tells_below_them():
    def small(strength, seed=0, count=60):
        kind = {"n_particles": 32, "n_bands": 4, "times": [0.0, 0.5, 1.0, 1.5, 2.0, 4.0, 8.0, 20.0]}
        return scene(**kind, realizations=count, seed=seed, disorder=tc.Disorder(strength=strength))

    transfers = [tc.band_transfer(small(strength), "modes") for strength in (0.2, 0.4)]
    family = tc.calibrate_family(transfers, bootstrap=0)
    found = family.at(0.3)
    fresh = tc.band_transfer(small(0.3, seed=5, count=200), "modes").starts
    for kind in ("released", "kicked"):
        told = found.starts.transfer(kind, fresh.tones, fresh.times)
        measured, noise = (getattr(fresh, name)[:, 1:] for name in (kind, f"{kind}_stderr"))
        off = {m: float(tc.total_variation(m.starts.transfer(kind, fresh.tones, fresh.times)[:, 1:], measured).mean()) for m in family.members}
        here = float(tc.total_variation(told[:, 1:], measured).mean())
        assert here < min(off.values()) / 2  # nearer than either neighbor
        assert here < 3 * float(tc.statistical_distance(noise).mean())
    assert found.solve(tc.Impulse(), [0.0, 9.0]).shape == (2, 4)
    assert family.at(0.1).starts is None
    with pytest.warns(tc.PredictionWarning, match="calibrated without other starts"):
        family.at(0.1).solve(tc.Impulse(), [1.0])
