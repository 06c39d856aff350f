"""What calibrate hands out by default: energies that are never negative, with a proof that its file keeps and load repeats."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.master import loss
from torchchain.master.certificate import certify
from torchchain.master.fits import FitWarning
from torchchain.master.proof import Certificate

B = 16
LATE = torch.cat([torch.zeros(1), torch.logspace(-4, 6, 600)]).double()


def ensemble(disorder, **settings):
    scene = tc.Scene(n_particles=128, n_bands=B, realizations=60, disorder=disorder, **settings)
    return tc.band_transfer(scene, starts=False)


@pytest.fixture(scope="module")
def transfer():
    return ensemble(tc.Disorder(strength=0.3))


@pytest.fixture(scope="module")
def strong():
    return ensemble(tc.Disorder("binary", 0.7))


@pytest.fixture(scope="module")
def memory(transfer):
    return tc.calibrate(transfer, "projection", bootstrap=4)


def starts(count=20, seed=0):
    """Energies spread at random, over all bands and over few."""
    random = np.random.default_rng(seed)
    return torch.from_numpy(np.concatenate([random.dirichlet(np.full(B, a), count) for a in (1.0, 0.05)]))


def assert_never_negative(master, starts):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        energies = master.solve(starts, LATE)
    assert float(energies.min()) >= -1e-12
    assert float((energies.sum(-1) - starts.sum(-1, keepdim=True)).abs().max()) < 1e-11


def test_the_default_is_never_negative(transfer):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        master = tc.calibrate(transfer, bootstrap=4)
    assert master.calibration.report.certificate.holds
    assert_never_negative(master, starts())
    assert "never negative" in str(master)


def test_memory_is_never_negative_and_near(transfer, memory):
    assert memory.calibration.report.certificate == certify(memory.model)
    assert_never_negative(memory, starts())
    free = tc.calibrate(transfer, order=memory.calibration.report.fit.order, bootstrap=0).model
    assert not certify(free).holds
    off, before = (
        float(tc.total_variation(model.transfer(transfer.times), transfer.mean)[:, 1:].mean())
        for model in (memory.model, free)
    )
    assert off <= 1.05 * before
    # error bars: of T at the same times and shapes as for any other model
    errors = memory.uncertainty.stderr
    assert errors.shape == (B, len(memory.uncertainty.times), B)
    assert bool(errors.isfinite().all())
    assert memory.standard_error(starts(2), [1.0, 30.0]).shape == (4, 2, B)


def test_strong_binary_disorder_does_not_diverge(strong):
    """The free fit with the most functions goes to hundreds of times the energy after the data."""
    master = tc.calibrate(strong, "projection", bootstrap=0)
    assert_never_negative(master, starts())
    assert_never_negative(tc.calibrate(strong, bootstrap=0), starts())


def test_what_diverges_is_never_silent(strong):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        master = tc.calibrate(strong, "projection", order=(5, 8), bootstrap=0)
    found = certify(master.model)
    assert (master.calibration.report.certificate is not None) == found.holds
    assert -0.1 <= found.lower <= found.upper <= 1.1 or any("of the energy" in str(w.message) for w in caught)


def test_an_order_that_is_asked_for_is_fitted_as_it_is(transfer):
    master = tc.calibrate(transfer, order=(1, 2), bootstrap=0)
    assert len(master.model.amplitudes) == 5
    assert master.calibration.report.certificate is None  # its energies are negative at early times
    assert not certify(master.model).holds


@pytest.mark.parametrize("order", [(1, 2), (3, 4), (2, 2)])  # the last is none that selection tries
def test_an_order_that_is_asked_for_can_be_certified(transfer, order):
    with pytest.warns(FitWarning, match="certified=True makes one of that order"):
        free = tc.calibrate(transfer, order=order, bootstrap=0)
    master = tc.calibrate(transfer, order=order, certified=True, bootstrap=0)
    assert master.calibration.report.fit.order == order
    assert master.calibration.report.certificate == certify(master.model)
    energies = torch.einsum("ms,str->mtr", starts(), master.model.transfer(LATE))
    assert float(energies.min()) >= -1e-12
    assert float((energies.sum(-1) - 1).abs().max()) < 1e-11
    off, far = (
        float(tc.total_variation(each.model.transfer(transfer.times), transfer.mean)[:, 1:].mean())
        for each in (master, free)
    )
    assert off < 1.05 * far  # the functions for the first collisions more than make up for it


def test_damped_chains_have_no_certificate():
    damped = tc.band_transfer(
        tc.Scene(n_particles=32, n_bands=4, realizations=4, damping=0.05, times=np.arange(0, 20, 0.5))
    )
    with pytest.raises(FieldError, match="certified must be False for damped chains"):
        tc.calibrate(damped, "projection", order=(1, 1), certified=True)


def test_joined_bands_stay_certified(memory):
    joined = memory.coarsened(4)
    assert joined.calibration.report.certificate == certify(joined.model)
    assert joined.calibration.report.certificate.holds


def test_file_keeps_the_certificate_and_load_verifies_it(memory, tmp_path):
    path = tmp_path / "m.safetensors"
    memory.save(path)
    again = tc.MasterEquation.load(path)
    assert again.calibration.report == memory.calibration.report
    assert torch.equal(again.transfer(LATE), memory.transfer(LATE))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lower": 1e-3}, "certificate must hold for its model: lower 0.001"),
        ({"upper": 0.9}, "certificate must hold for its model: upper 0.9"),
        ({"conservation_defect": -1.0}, "certificate must hold for its model: conservation_defect -1"),
        ({"lower": -0.5}, "report.certificate.lower must be at least -1e-12, got -0.5"),
        ({"lower": "none"}, "report.certificate.lower must"),
        ({"more": 1}, "report.certificate must have only the keys"),
    ],
)
def test_a_changed_certificate_is_refused(change, message, memory, tmp_path):
    path = tmp_path / "m.safetensors"
    memory.save(path)
    header, tensors = contents(path)
    header["report"]["certificate"].update(change)
    save_file(tensors, path, metadata={"torchchain": json.dumps(header)})
    with pytest.raises(FieldError, match=message) as error:
        tc.MasterEquation.load(path)
    assert "\n" not in str(error.value)


def test_a_changed_model_is_refused(memory, tmp_path):
    """Amplitudes that still add up to the start, of a model that is no longer the one that was proved."""
    path = tmp_path / "m.safetensors"
    memory.save(path)
    header, tensors = contents(path)
    push = torch.zeros_like(tensors["amplitudes"])
    push[-1, 0, 0], push[-1, 0, 1] = 0.5, -0.5  # a sine, nothing at time 0
    save_file(tensors | {"amplitudes": tensors["amplitudes"] + push}, path, metadata={"torchchain": json.dumps(header)})
    with pytest.raises(FieldError, match="certificate must hold for its model: lower"):
        tc.MasterEquation.load(path)


def test_single_precision_is_saved_without_a_claim(memory, tmp_path):
    path = tmp_path / "m.safetensors"
    single = tc.MasterEquation.load(saved(memory, path)).float()
    again = tc.MasterEquation.load(saved(single, path))
    assert again.calibration.report.certificate is None
    assert replace(memory.calibration.report, certificate=None) == again.calibration.report


def test_a_report_takes_no_certificate_that_proves_nothing():
    with pytest.raises(FieldError, match="report.certificate.lower must be at least -1e-12, got -0.2"):
        tc.master.Report(certificate=Certificate(-0.2, 1.0, 0.0, 1.0, 1))


def saved(master, path):
    master.save(path)
    return path


def contents(path):
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["torchchain"]), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


# The compact model, by name


@pytest.fixture(scope="module")
def compact(transfer):
    return tc.calibrate(transfer, model="compact", bootstrap=6)


def test_compact_is_selected_by_name(transfer, compact):
    record = compact.calibration
    assert (record.method, record.model) == ("logistic", "compact")
    assert compact.n_parameters < 500 < B * B * 2
    assert compact.n_parameters == len(compact.model.coefficients)
    assert {rung.model for rung in record.report.selection.tried} == {"compact"}
    assert record.report.fit.degrees == compact.model.degrees_
    assert record.report.certificate.holds
    assert compact.conservation_defect == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tc.master.PredictionWarning)  # times beyond the data
        energies = compact.solve(starts(), LATE)
    assert float(energies.min()) >= 0
    assert float((energies.sum(-1) - 1).abs().max()) < 1e-12
    halves = record.report.selection.halves_distance
    off = tc.total_variation(compact.model.transfer(transfer.times), transfer.mean)[:, 1:].mean()
    assert float(off) < halves


def test_compact_error_bars_come_from_its_own_refits(transfer, compact):
    errors = compact.uncertainty
    for part in (errors.stderr[:, 1:], errors.rates_stderr, errors.basis_stderr):
        assert bool(part.isfinite().all())
        assert float(part.max()) > 0
    # a model of few numbers averages the noise of many energies: its error is not above the ensemble's own by much
    own = transfer.stderr[:, 1:].square().mean().sqrt()
    assert 0.05 * own < errors.stderr[:, 1:].square().mean().sqrt() < 2 * own


def test_compact_is_saved_and_loaded(compact, tmp_path):
    again = tc.MasterEquation.load(saved(compact, tmp_path / "c.safetensors"))
    assert again.model.kind == "compact"
    assert again.calibration.report == compact.calibration.report
    times = [0.0, 0.3, 7.0, 50.0]
    assert torch.equal(again.transfer(times), compact.transfer(times))
    assert torch.equal(again.standard_error(starts(1), times), compact.standard_error(starts(1), times))


def test_compact_solves_as_a_linear_equation_nearly(compact):
    """By the nearest model with memory: within the error bars on average."""
    times = [0.0, 1.0, 10.0, 40.0]
    eye = torch.eye(B, dtype=torch.float64)
    apart = (compact.solve(eye, times, "dopri8") - compact.solve(eye, times)).abs()
    assert float(apart.mean()) < 2 * float(compact.uncertainty.stderr.mean())
    assert compact.coarsened(4).calibration.report.certificate.holds


def test_compact_refuses_chains_it_is_not_made_for():
    scene = tc.Scene(n_bands=4, lattice="square", shape=(6, 6))
    with pytest.raises(FieldError, match="lattice must be none for model 'compact', got square"):
        tc.master.calibration.recipe(scene, model="compact")
    with pytest.raises(FieldError, match="degrees must be at least 1"):
        tc.master.calibration.recipe(tc.Scene(), degrees=(0, 1, 2))


# Other chains: beside walls, damped


@pytest.mark.parametrize("settings", [{"boundary": "fixed"}, {"damping": 0.01}, {"damping": 0.1, "boundary": "fixed"}])
def test_walls_and_damping_keep_the_default_never_negative(settings):
    times = np.arange(0, 60, 0.5)
    scenes = [
        tc.Scene(n_particles=64, n_bands=8, realizations=100, times=times, seed=seed, **settings) for seed in (0, 1)
    ]
    own, fresh = (tc.band_transfer(scene, long_time="damping" not in settings) for scene in scenes)
    master = tc.calibrate(own, bootstrap=8)
    assert master.calibration.report.certificate.holds
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "prediction to time")
        late = master.transfer(LATE)
        assert float(late.min()) >= 0
        assert float(late.sum(-1).max()) <= 1 + 1e-12
        if "damping" in settings:
            assert bool((late.sum(-1).diff(dim=1) <= 1e-14).all())
        off = tc.total_variation(master.transfer(times), fresh.mean)[:, 1:].mean()
        error = master.standard_error(torch.eye(8, dtype=torch.float64), times).square() + fresh.stderr.square()
        inside = (master.transfer(times) - fresh.mean).square() < error
    assert float(off) < 1.35 * float(tc.statistical_distance(fresh.stderr)[:, 1:].mean())
    assert 0.55 < float(inside[:, 1:].double().mean()) < 0.85


def test_what_is_left_of_damped_modes():
    """Against the equation of motion, below, at and above critical damping; a known mixture comes back."""
    times = np.linspace(0, 20, 41)
    for damping, w in ((0.1, 0.7), (2.0, 1.0), (1.5, 2.0)):
        generator = np.array([[0.0, w], [-w, -damping * w**2]])
        exact = [float(((scipy.linalg.expm(generator * t) @ [1.0, 0.0]) ** 2).sum()) for t in times]
        found = loss.mode_energy(np.array([w]), damping, times)[:, 0]
        np.testing.assert_allclose(found, exact, atol=1e-6)
    weights = np.zeros((1, loss.MODES))
    weights[0, [5, 20]] = 0.3, 0.7
    left = weights @ loss.mode_energy(loss.frequencies(), 0.1, times).T
    found = loss.mixture(left, 0.1, times)
    np.testing.assert_allclose(found @ loss.mode_energy(loss.frequencies(), 0.1, times).T, left, atol=1e-6)


def test_a_family_of_damped_chains(tmp_path):
    times = np.arange(0, 40, 0.5)
    scenes = [
        tc.Scene(
            n_particles=32, n_bands=4, realizations=40, times=times, damping=0.05, disorder=tc.Disorder(strength=xi)
        )
        for xi in (0.1, 0.2, 0.3)
    ]
    transfers = [tc.band_transfer(scene) for scene in scenes]
    family = tc.calibrate_family([transfers[0], transfers[2]], degrees=(4, 3, 6), bootstrap=4)
    family.save(tmp_path / "family.safetensors")
    member = tc.MasterFamily.load(tmp_path / "family.safetensors").at(0.2)
    found = member.transfer(times)
    assert float(found.min()) >= 0
    off = tc.total_variation(found, transfers[1].mean)[:, 1:].mean()
    assert float(off) < 2 * float(tc.statistical_distance(transfers[1].stderr)[:, 1:].mean())
    again = member.coarsened(2).transfer(times)
    assert float((again.sum(-1) - found.unflatten(0, (2, 2)).mean(1).sum(-1)).abs().max()) < 0.02
