"""Reduced models from outside, data without a scene, the paper's rates with error bars, and what models print."""

import json
import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.master import MODELS, Fit, Loss, ReducedModel, TransferModel, Uncertainty

B = 4
EYE = torch.eye(B, dtype=torch.float64)
TIMES = np.arange(0, 20.01, 0.5)


class Relaxation(TransferModel):
    """Every source relaxes to its long-time average with one and the same rate."""

    kind = "relaxation"
    axes = {"basis": ("band", "band"), "damping": ("band",), "rate": ("number",)}  # noqa: RUF012

    def __init__(self, basis, damping, rate):
        super().__init__()
        for name, value in (("basis", basis), ("damping", damping), ("rate", rate)):
            self.register_buffer(name, value)

    @property
    def n_parameters(self):
        return self.basis.numel() + 1

    def embedding(self):
        eye = torch.eye(self.n_bands, dtype=self.basis.dtype)
        generator = torch.block_diag(-self.rate * eye, 0 * eye)
        return tc.master.Embedding(torch.cat([eye - self.basis, self.basis], 1), generator, torch.cat([eye, eye]))


@dataclass(frozen=True)
class RelaxationReport:
    rate: float
    words: tuple[str, ...] = ()


def relax(sample, recipe, near, progress):
    own = sample.mean.diagonal(dim1=0, dim2=2) - sample.long_time.diagonal()  # [time, band]
    early = own[1:6].clamp(min=1e-6).log() - own[0].clamp(min=1e-6).log()
    rate = -float((early.mean(-1) / sample.times[1:6]).mean())
    model = Relaxation(
        sample.long_time, torch.zeros(sample.n_bands).to(sample.mean), torch.tensor([rate], dtype=torch.float64)
    )
    return model, RelaxationReport(rate, ("early",))


RECORD = ReducedModel(
    "relaxation", "one rate for all", Relaxation, (Fit("early_decay", "own bands at early times", relax, report=RelaxationReport),),
    lambda n_bands, damped, settings: n_bands**2 + 1, climbed_by="early_decay", default=True, needs_long_time=True,
)  # fmt: skip


def energies(rate=0.3, noise=0.003, realizations=24, seed=0, extra=0.0):
    """(realization, source, time, receiver): relaxation to an even spread, ``extra`` of it fast, with noise of zero sum."""
    decay = (1 - extra) * np.exp(-rate * TIMES)[:, None] + extra * np.exp(-8 * rate * TIMES)[:, None]
    even = np.full(B, 1 / B)
    mean = np.stack([even + (np.eye(B)[s] - even) * decay for s in range(B)])
    shake = noise * np.random.default_rng(seed).normal(size=(realizations, *mean.shape))
    shake -= shake.mean(-1, keepdims=True)
    shake[:, :, 0] = 0
    return mean + shake


def imported(**settings):
    return tc.BandTransfer.from_energies(
        TIMES, energies(**settings), long_time=np.full((B, B), 1 / B), provenance="frames of another code"
    )


@pytest.fixture
def registered():
    tc.register_model(RECORD)
    yield
    del MODELS["relaxation"]


# A model from outside


def test_a_model_from_outside_goes_all_the_way(registered, tmp_path):
    transfer = imported()
    master = tc.calibrate(transfer, "early_decay")
    assert isinstance(master.model, Relaxation)
    assert master.calibration.report.fit == RelaxationReport(float(master.model.rate), ("early",))
    assert float(master.model.rate) == pytest.approx(0.3, rel=0.05)
    assert float(master.uncertainty.stderr.max()) < 0.02
    np.testing.assert_allclose(master.rates.numpy(), -0.3 * (np.eye(B) - 1 / B), atol=0.02)  # the slope at time 0
    master.save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert (type(again.model), again.calibration) == (Relaxation, master.calibration)
    assert torch.equal(again.transfer([1.0, 7.0]), master.transfer([1.0, 7.0]))
    assert torch.allclose(again.solve(EYE, [7.0], "dopri8"), again.solve(EYE, [7.0]), atol=1e-7)


def test_selection_tries_a_model_from_outside(registered):
    master = tc.calibrate(imported(extra=0.4), bootstrap=0)  # one rate is not enough
    tried = master.calibration.report.selection.tried
    assert "relaxation" in [rung.model for rung in tried]


def test_without_its_registration_the_file_is_refused(tmp_path, registered):
    path = tmp_path / "q.safetensors"
    tc.calibrate(imported(), "early_decay", bootstrap=0).save(path)
    record = MODELS.pop("relaxation")
    try:
        with pytest.raises(FieldError, match="kind must be one of markov, swing_in, memory"):
            tc.MasterEquation.load(path)
    finally:
        MODELS["relaxation"] = record


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "paper"}, "name must differ from paper"),
        ({"name": "two words"}, "name must be an identifier"),
        ({"fits": ()}, "fits must be at least one"),
        ({"climbed_by": "x"}, "climbed_by must be one of early_decay"),
        ({"kind": torch.nn.Linear}, "kind must be a TransferModel"),
        ({"fits": (Fit("linear", "", relax),), "climbed_by": None}, "fits must have names that no other fit has"),
    ],
)
def test_records_that_are_refused(change, message):
    with pytest.raises(FieldError, match=message):
        tc.register_model(replace(RECORD, **change))
    assert "relaxation" not in MODELS


def test_a_kind_that_another_model_has_is_refused():
    class Other(Relaxation):
        kind = "memory"

    with pytest.raises(FieldError, match="kind must be free, got memory"):
        tc.register_model(replace(RECORD, kind=Other))


# Data without a scene


def test_data_without_a_scene_are_calibrated_saved_and_predicted(tmp_path):
    transfer = imported()
    assert transfer.scene is None
    master = tc.calibrate(transfer)
    assert master.uncertainty is not None
    assert master.calibration.report.selection.held_out_distance > 0
    assert all(rung.model != "paper" for rung in master.calibration.report.selection.tried)  # Psi needs the disorder
    master.save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert again.calibration == master.calibration
    assert (again.calibration.scene, again.calibration.provenance) == (None, "frames of another code")
    exact = 1 / B + (1 - 1 / B) * math.exp(-0.3 * 5)
    assert again.solve(EYE[0], [5.0])[0, 0].item() == pytest.approx(exact, abs=0.005)
    assert again.horizon == master.horizon > 0
    assert "without a scene" in again.concerns(tc.Scene(n_particles=32, n_bands=B, times=[0.0, 1.0]))[-1]
    assert again.coarsened(2).n_bands == 2 if again.model.kind == "memory" else True
    with pytest.raises(FieldError, match="members must be calibrated on chains of a scene"):
        tc.MasterFamily([again])
    with pytest.raises(FieldError, match="transfer must tell the strength of the disorder"):
        tc.calibrate(transfer, "linear", "paper")


def test_data_without_a_scene_print_where_they_come_from():
    assert "frames of another code" in repr(tc.calibrate(imported(), bootstrap=0))


# The paper's rates


def test_paper_rates_are_procedure_l(small_transfer):
    found = tc.paper_rates(small_transfer)
    assert {"source", "receiver"} <= set(found.dims)
    master = tc.calibrate(small_transfer, "linear", "paper")
    np.testing.assert_allclose(found.rates.values, master.rates.detach().numpy(), rtol=1e-10, atol=1e-15)
    # the jackknife of a mean is the standard error of the blocks' own slopes
    inside = (small_transfer.times >= 0.5) & (small_transfer.times <= 2)
    t = small_transfer.times[inside] - small_transfer.times[inside].mean()
    free = 1 - tc.basis_fraction(0.3, small_transfer.n_bands)
    slopes = torch.einsum("t,bstr->bsr", t, small_transfer.block_mean[:, :, inside]) / t.square().sum() / free[:, None]
    weight = torch.tensor(small_transfer.block_counts, dtype=torch.float64)
    if len(weight.unique()) == 1:
        expected = slopes.std(0) / len(weight) ** 0.5
        np.testing.assert_allclose(found.rates_stderr.values, expected.numpy(), rtol=1e-8)
    assert found.source.values.tolist() == list(range(1, small_transfer.n_bands + 1))
    assert found.rates.sel(source=3, receiver=3) < 0
    with pytest.raises(FieldError, match="window must hold"):
        tc.paper_rates(small_transfer, (0.6, 0.7))


def test_paper_rates_of_data_without_a_scene_need_the_disorder():
    with pytest.raises(FieldError, match="transfer must tell the strength"):
        tc.paper_rates(imported())
    weaker, stronger = (tc.paper_rates(imported(), strength=xi).rates.values for xi in (0.1, 0.4))
    assert (np.abs(weaker.diagonal()) > np.abs(stronger.diagonal())).all()  # less of the energy is free


def test_rates_say_what_they_are(small_transfer):
    linear = tc.calibrate(small_transfer, "linear", "paper")
    memory = tc.calibrate(small_transfer, order=(1, 1))
    assert "which the prediction uses" in linear.rates_meaning
    assert "the prediction does not use" in memory.rates_meaning
    inside = (small_transfer.times >= 0.5) & (small_transfer.times <= 2)
    lines = np.polyfit(small_transfer.times[inside].numpy(), small_transfer.mean[1, inside].numpy(), 1)[0]
    np.testing.assert_allclose(memory.rates[1].numpy(), lines, atol=1e-12)
    for master in (linear, memory):
        assert master.rates_meaning in repr(master)


# Joined bands


def test_joined_bands_keep_damping_and_error_bars():
    n = 4
    model = tc.MemoryModel(
        torch.zeros(n, n), torch.zeros(n, n), torch.eye(n, dtype=torch.float64)[None], torch.tensor([0.1]), torch.zeros(0), torch.zeros(0)
    )  # fmt: skip
    errors = Uncertainty(*(torch.full((n, n), 0.1),) * 2, torch.tensor([0.0, 1.0]), torch.full((n, 2, n), 0.1))
    scene = tc.Scene(n_particles=32, n_bands=n, damping=0.1, times=[0.0, 1.0])
    report = tc.master.Report(loss=Loss((0.1, 0.3, 0.5, 0.7), 0.0), horizon=7.0, bootstrap=20)
    master = tc.MasterEquation(model, tc.master.Calibration("projection", "memory", None, scene, report), errors)
    joined = master.coarsened(2)
    assert joined.damping.tolist() == pytest.approx([0.2, 0.6])
    assert joined.horizon == 7.0
    assert joined.calibration.report.coarsened_from == 4
    # two independent sources of a half each, two receivers whose errors may be one: 2 * 0.1 / sqrt(2)
    assert joined.standard_error(torch.eye(2), [0.5]).flatten().tolist() == pytest.approx([0.2 / 2**0.5] * 4)


def test_joined_error_bars_hold(small_transfer):
    master = tc.calibrate(small_transfer, order=(1, 1))
    half = small_transfer.n_bands // 2
    joined = master.coarsened(half)
    fine, wide = master.uncertainty.stderr, joined.uncertainty.stderr
    assert wide.shape == (half, fine.shape[1], half)
    assert float(wide.mean()) < 2 * float(fine.mean())


# Files


def test_the_wording_of_conventions_may_change(small_transfer, tmp_path, monkeypatch):
    from torchchain.master import file

    tc.calibrate(small_transfer, "linear", "paper").save(tmp_path / "q.safetensors")
    monkeypatch.setitem(file.CONVENTIONS, "units", "in other words")
    tc.MasterEquation.load(tmp_path / "q.safetensors")
    monkeypatch.setitem(file.CONVENTIONS, "version", 2)
    with pytest.raises(FieldError, match="follow version 2 of the conventions, got 1"):
        tc.MasterEquation.load(tmp_path / "q.safetensors")


def test_a_model_of_ones_own_is_saved(tmp_path):
    tc.MasterEquation(tc.RateModel(EYE * 0, EYE), None).save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert (again.calibration.model, again.calibration.scene) == ("given", None)
    assert torch.equal(again.transfer([3.0])[:, 0].detach(), EYE)


def test_reports_are_saved_field_by_field(small_transfer, tmp_path):
    master = tc.calibrate(small_transfer)
    master.save(tmp_path / "q.safetensors")
    again = tc.MasterEquation.load(tmp_path / "q.safetensors")
    assert again.calibration.report == master.calibration.report
    assert again.calibration.report.selection.tried == master.calibration.report.selection.tried
    json.dumps(master.calibration.report.to_dict(), allow_nan=False)


# What is printed


def test_what_a_model_prints(small_transfer):
    master = tc.calibrate(small_transfer)
    lines = repr(master).splitlines()
    assert 6 <= len(lines) <= 10
    assert re.search(r"model +memory|model +\w+, fitted by", repr(master))
    assert "<table>" in master._repr_html_()
    assert master.n_parameters == master.model.n_parameters
    assert tc.calibrate(small_transfer, "analytic", "paper").n_parameters == 1
    predicted = master.transfer(small_transfer.times)
    assert predicted.shape == small_transfer.mean.shape
    assert torch.equal(predicted, master.solve(torch.eye(small_transfer.n_bands), small_transfer.times))
