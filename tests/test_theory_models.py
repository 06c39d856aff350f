"""The theory as a reduced model, and the corrected theory: exact properties, file, selection, and distance from fresh chains."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.master import TheoryModel, theory_rings
from torchchain.master.compact import n_coefficients
from torchchain.master.derived import _regression, foresee
from torchchain.master.logistic import stepped
from torchchain.master.ringing import DECAY, Ringing, size_of
from torchchain.master.sample import Sample
from torchchain.master.selection import rungs

F64 = torch.float64
TIMES = torch.cat([torch.arange(0.0, 2.0, 0.25), torch.arange(2.0, 60.0, 4.0)]).double()
SCENE = tc.Scene(n_particles=64, n_bands=8, disorder=tc.Disorder(strength=0.3), times=TIMES, realizations=40, seed=4)
BINARY = replace(SCENE, disorder=tc.Disorder("binary", 0.5))
RINGS = (2, 2, 4, 1, 3)
LATE = torch.tensor([0.0, 0.1, 1.0, 13.0, 700.0, 1e4, 1e7, torch.inf], dtype=F64)


@pytest.fixture(scope="module")
def transfer():
    return tc.band_transfer(SCENE, method="modes", starts=False)


@pytest.fixture(scope="module")
def fresh():
    return tc.band_transfer(replace(SCENE, seed=5, realizations=400), method="modes", starts=False)


def distance(a, b):
    """Total variation, mean over sources and times above 2."""
    return float((a - b)[:, TIMES > 2].abs().sum(-1).mean() / 2)


def corrected(scale):
    size = n_coefficients((2, 2, 4))
    noise = torch.randn(size, generator=torch.Generator().manual_seed(1), dtype=F64)
    return TheoryModel.of(SCENE, (2, 2, 4), scale * noise)


@pytest.fixture(scope="module")
def binary():
    return tc.band_transfer(BINARY, method="modes", starts=False)


def ringing(scale, smooth=None):
    """With coefficients of the polynomials, too, as large as ``smooth``."""
    noise = torch.randn(size_of(RINGS), generator=torch.Generator().manual_seed(2), dtype=F64)
    noise[: n_coefficients(RINGS[:3])] *= (scale if smooth is None else smooth) / max(scale, 1e-300)
    return TheoryModel.of(BINARY, RINGS, scale * noise)


def test_without_a_fitted_number_it_is_the_theory(transfer):
    master = tc.calibrate(transfer, model="theory")
    theory = tc.band_transfer(SCENE, method="theory")
    assert master.n_parameters == 0
    # where the theory is slightly negative, as an ensemble's mean is, there is hardly anything; the rest is scaled
    positive = theory.mean.clamp(min=0)
    positive = positive / positive.sum(-1, keepdim=True)
    torch.testing.assert_close(master.transfer(TIMES), positive, rtol=0, atol=1e-4)
    torch.testing.assert_close(master.basis, theory.long_time, rtol=0, atol=1e-5)


def test_zero_coefficients_change_nothing():
    torch.testing.assert_close(corrected(0.0).transfer(LATE), TheoryModel.of(SCENE).transfer(LATE), rtol=0, atol=1e-14)


@pytest.mark.parametrize("scale", [0.0, 0.3, 30.0])
def test_any_coefficients_give_a_transfer_that_conserves_energy_and_is_never_negative(scale):
    found = corrected(scale).transfer(LATE)
    assert float(found.min()) >= 0
    torch.testing.assert_close(found.sum(-1), torch.ones(8, len(LATE), dtype=F64), rtol=0, atol=1e-13)
    torch.testing.assert_close(found[:, 0], torch.eye(8, dtype=F64), rtol=0, atol=1e-15)


@pytest.mark.parametrize("scale", [0.0, 0.3, 30.0])
def test_any_ringing_conserves_energy_is_never_negative_and_dies_out(scale):
    found = ringing(scale).transfer(LATE)
    assert float(found.min()) >= 0
    torch.testing.assert_close(found.sum(-1), torch.ones(8, len(LATE), dtype=F64), rtol=0, atol=1e-13)
    torch.testing.assert_close(found[:, 0], torch.eye(8, dtype=F64), rtol=0, atol=1e-15)
    silent = ringing(scale)
    silent.coefficients[n_coefficients(RINGS[:3]) :] = 0
    assert torch.equal(found[:, -1], silent.transfer(LATE)[:, -1])
    assert (float((found - silent.transfer(LATE))[:, 2:4].abs().max()) > 1e-3) is (scale > 0)


def test_ringing_is_what_the_formula_says():
    model = ringing(0.3)
    rings = Ringing.of(model.ring, 1, 3)
    t, s, r = 7.0, 5, 2
    coefficients = model.coefficients[-size_of(RINGS) + n_coefficients(RINGS[:3]) :].reshape(
        2, 3, 3
    )  # cosine or sine, W, product
    place = [[1.0, 2 * x / 7 - 1] for x in (s, r)]
    low, high = 1.2 / np.sqrt(1.5), 2 / np.sqrt(0.5)
    expected = 0.0
    for here, there, tone in ((*place, BINARY.tones[s]), (*place[::-1], BINARY.tones[r])):
        shapes = np.array([here[i] * there[j] for i, j in ((0, 0), (0, 1), (1, 0))])
        for number, cluster in enumerate((low, (low + high) / 2, high)):
            phase = (cluster - 2 * np.sin(np.pi * tone / 64)) * t
            parts = np.cos(phase) * coefficients[0, number].numpy() + np.sin(phase) * coefficients[1, number].numpy()
            expected += float(parts @ shapes)
    expected *= np.exp(-DECAY * t) * (1 - np.exp(-(t**2) / 4))
    found = rings.exponent(torch.tensor([t], dtype=F64), coefficients.flatten())
    assert float(found[s, 0, r]) == pytest.approx(expected, rel=1e-12)


def test_pull_is_the_slope_of_the_misfit(binary):
    problem, _ = _regression(Sample.of(binary), RINGS)
    rng = np.random.default_rng(0)
    at, along = rng.normal(size=(2, problem.size)) * 0.1
    _, pull = problem.normal(problem.predicted(at), at)
    step = 1e-5
    down, up = (problem.misfit(at + x * along)[0] for x in (-step, step))
    assert (up - down) / (2 * step) == pytest.approx(-2 * pull @ along, rel=1e-5)


def test_one_step_follows_data_that_are_drawn_again(binary):
    problem, _ = _regression(Sample.of(binary), RINGS)
    rng = np.random.default_rng(0)
    found, changed = rng.normal(size=(2, problem.size)) * [[0.1], [0.003]]
    own = replace(problem, data=problem.predicted(found))
    other = replace(problem, data=problem.predicted(found + changed))
    moved = stepped([own], np.ones((1, 1)), found[None], [other.data[None]])[0, 0]
    assert other.misfit(moved)[0] < 0.02 * other.misfit(found)[0]


@pytest.mark.parametrize("settings", [{}, {"model": "corrected_theory", "degrees": (1, 1, 2)}])
def test_file_holds_all_that_it_needs(transfer, tmp_path, settings):
    master = tc.calibrate(transfer, **({"model": "theory"} | settings))
    master.save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert torch.equal(again.transfer(LATE[:-1]), master.transfer(LATE[:-1]))
    assert torch.equal(again.basis, master.basis)
    assert again.n_parameters == master.n_parameters == (9 if settings else 0)
    assert again.calibration.report.certificate.holds


def test_the_theory_is_chosen_where_it_is_as_near_as_another_ensemble(transfer, fresh):
    master = tc.calibrate(transfer, bootstrap=0)
    assert (master.calibration.model, master.n_parameters) == ("theory", 0)
    assert "corrected_theory" in [rung.model for rung in master.calibration.report.selection.tried]  # no better
    assert distance(master.transfer(TIMES), fresh.mean) < distance(transfer.mean, fresh.mean)


def test_correction_comes_nearer_to_what_it_was_fitted_to(fresh):
    theory, mended = (tc.calibrate(fresh, bootstrap=0, **settings) for settings in (
        {"model": "theory"}, {"model": "corrected_theory", "degrees": (4, 4, 8)}))  # fmt: skip
    assert distance(mended.transfer(TIMES), fresh.mean) < 0.85 * distance(theory.transfer(TIMES), fresh.mean)


def test_correction_recovers_what_was_changed():
    changed = corrected(0.3)
    exact = changed.transfer(TIMES)
    late = changed.transfer(LATE[-1:])[:, 0]
    data = replace(tc.band_transfer(SCENE, method="theory"), mean=exact, long_time=late)
    master = tc.calibrate(data, model="corrected_theory", degrees=(2, 2, 4), bootstrap=0)
    bare = distance(TheoryModel.of(SCENE).transfer(TIMES), exact)
    assert bare > 0.02
    assert distance(master.transfer(TIMES), exact) < 0.15 * bare


def test_ringing_is_recovered():
    exact = ringing(0.3, 0.02).transfer(TIMES)
    late = ringing(0.3, 0.02).transfer(LATE[-1:])[:, 0]
    data = replace(tc.band_transfer(BINARY, method="theory"), mean=exact, long_time=late)
    rings, plain = (tc.calibrate(data, model=model, degrees=degrees, bootstrap=0).transfer(TIMES)
                    for model, degrees in (("ringing_theory", RINGS), ("corrected_theory", RINGS[:3])))  # fmt: skip
    assert distance(plain, exact) > 0.003
    assert distance(rings, exact) < 0.1 * distance(plain, exact)


def test_clusters_of_light_particles_ring_in_fresh_chains(binary):
    """As many numbers, most of them for the beats, come nearer than those for polynomials alone."""
    fresh = tc.band_transfer(replace(BINARY, seed=5, realizations=400), method="modes", starts=False)
    rings, plain = (tc.calibrate(fresh, bootstrap=0, model=model, degrees=degrees) for model, degrees in (
        ("ringing_theory", (4, 4, 8, 2, 8)), ("corrected_theory", (7, 5, 12))))  # fmt: skip
    assert rings.n_parameters <= plain.n_parameters
    other = tc.band_transfer(replace(BINARY, seed=6, realizations=400), method="modes", starts=False)
    assert distance(rings.transfer(TIMES), other.mean) < 0.93 * distance(plain.transfer(TIMES), other.mean)


def test_ringing_is_kept_in_a_file_with_its_error_bars(binary, tmp_path):
    master = tc.calibrate(binary, model="ringing_theory", degrees=RINGS)
    master.save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert torch.equal(again.transfer(LATE[:-1]), master.transfer(LATE[:-1]))
    assert again.n_parameters == size_of(RINGS) == 23 + 18
    assert again.calibration.report.certificate.holds
    own = torch.eye(8, dtype=bool)[:, None].expand(-1, len(TIMES), -1)
    error = again.standard_error(torch.eye(8, dtype=F64), TIMES)
    assert float(error[own][TIMES.repeat(8) > 1].min()) > 0


def test_chains_without_clusters_alike_do_not_ring(transfer, binary):
    with pytest.raises(FieldError, match="disorder.kind must be 'binary' for model 'ringing_theory'"):
        tc.calibrate(transfer, model="ringing_theory", degrees=RINGS)
    with pytest.raises(FieldError, match="degrees must be five integers"):
        tc.calibrate(binary, model="ringing_theory", degrees=(2, 2, 4))
    wide = tc.band_transfer(replace(BINARY, n_particles=512, n_bands=128, realizations=4), method="modes", starts=False)
    for data, tried in ((transfer, False), (binary, True), (wide, False)):  # of many bands its fit is slow
        found = [recipe.model.name for recipe in rungs(tc.Recipe(None, None, (0.5, 2.0)), data)]
        assert ("ringing_theory" in found) is tried


def test_damped_chains_lose_the_energy_that_the_theory_says():
    scene = replace(SCENE, damping=0.05, realizations=20, disorder=tc.Disorder(strength=0.2))
    transfer = tc.band_transfer(scene, long_time=False, starts=False)
    master = tc.calibrate(transfer, model="theory")
    found = master.transfer(TIMES)
    torch.testing.assert_close(found.sum(-1), transfer.mean.sum(-1), rtol=0, atol=0.006)
    assert float(found.min()) >= 0
    with pytest.warns(tc.PredictionWarning, match="the model 'theory' obeys no differential equation: 'dopri5' takes the nearest"):
        solved = master.solve(torch.eye(8, dtype=F64), TIMES, method="dopri5")  # by the nearest model with memory
    assert distance(solved, found) < 0.01


def test_error_bars_hold_the_misfit_though_nothing_is_drawn_again(transfer, fresh):
    master = tc.calibrate(transfer, model="theory")
    error = master.uncertainty.stderr
    assert bool((error >= 0).all())
    off = (master.transfer(TIMES) - fresh.mean).abs()
    allowed = 3 * (master.standard_error(torch.eye(8, dtype=F64), TIMES) + fresh.stderr) + 0.004
    assert float((off <= allowed).double().mean()) > 0.95


@pytest.mark.parametrize(
    ("fields", "words"),
    [({"boundary": "fixed"}, "boundary must be 'periodic'"), ({"energy_definition": "bond"}, "energy_definition must be site")],
)  # fmt: skip
def test_chains_that_the_theory_does_not_hold_for_are_refused(fields, words):
    with pytest.raises(FieldError, match=words):
        TheoryModel.of(replace(SCENE, **fields))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("coefficients", torch.zeros(2, dtype=F64), "coefficients must have shape"),
        ("tones", torch.arange(1.0, 9.0, dtype=F64), "tones must lie one in each band"),
        ("law_weights", torch.full((48,), 0.5, dtype=F64), "law_weights must add up to 1"),
        ("n_particles", torch.tensor(64.5, dtype=F64), "n_particles must be an integer"),
    ],
)
def test_tensors_that_make_no_model_are_refused(name, value, words):
    tensors = TheoryModel.of(SCENE).tensors() | {name: value}
    with pytest.raises((FieldError, TypeError), match=words):
        TheoryModel(**tensors)


@pytest.mark.parametrize(("n_particles", "n_bands", "tried"), [(32, 4, False), (64, 4, False), (64, 8, True)])
def test_selection_tries_the_theory_where_it_was_compared_with_chains(n_particles, n_bands, tried):
    scene = tc.Scene(n_particles=n_particles, n_bands=n_bands, realizations=8, times=[0.0, 1.0, 2.0, 8.0, 20.0])
    found = [
        recipe.model.name for recipe in rungs(tc.Recipe(None, None, (0.5, 2.0)), tc.band_transfer(scene, starts=False))
    ]
    assert ("theory" in found) is tried
    assert ("corrected_theory" in found) is tried


def test_what_a_selection_asks_of_the_theory_is_computed_once_and_ahead(transfer, monkeypatch):
    asked, compute = [], theory_rings.transfer_of_law

    def counted(law, waves, times):
        asked.append(times)
        return compute(law, waves, times)

    monkeypatch.setattr(theory_rings, "_kept", {})
    monkeypatch.setattr(theory_rings, "transfer_of_law", counted)
    with ThreadPoolExecutor(2) as pool:  # one waits for the other's
        list(pool.map(foresee, [SCENE, SCENE]))
    assert len(asked) == 1
    tc.calibrate(transfer, bootstrap=0)
    assert len(asked) == 1
    for other in (replace(SCENE, realizations=2), replace(SCENE, n_bands=4), replace(SCENE, boundary="fixed")):
        foresee(other)
    assert len(asked) == 1
