"""Error bars: what they are made of, fits that go astray, and how often they hold for chains that were not calibrated on."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.master import Uncertainty
from torchchain.master.alike import factors
from torchchain.master.uncertainty import of_parts, winsorized

B = 6
SEEDS = range(20, 36)
TIMES = torch.tensor([0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 60.0], dtype=torch.float64)
WINDOWS = ((0.0, 1.0), (1.0, 5.0), (5.0, 60.0))
OWN = torch.eye(B, dtype=torch.bool)[:, None]


def ensemble(seed, strength=0.3):
    scene = tc.Scene(
        n_particles=48, n_bands=B, realizations=60, seed=seed, times=TIMES, disorder=tc.Disorder(strength=strength)
    )  # fmt: skip
    return tc.band_transfer(scene, method="modes", starts=False)


@pytest.fixture(scope="module")
def ensembles():
    return [ensemble(seed) for seed in SEEDS]


def windows(within):
    """Means of [start, time, receiver] over starts and receivers in each window."""
    times = TIMES
    return torch.stack([within[:, (times > low) & (times <= high)].mean((0, 1, 2)) for low, high in WINDOWS])


def over_pairs(inside):
    """Mean over pairs (one, other, ...) of different ensembles, and its error by leaving out one at a time.

    Energies of one ensemble err alike: pairs are not independent, and energies less so.
    """
    other = (1 - torch.eye(len(inside))).double()

    def mean(kept):
        weight = other[kept][:, kept]
        return torch.einsum("ij,ij...->...", weight / weight.sum(), inside[kept][:, kept])

    every = torch.arange(len(inside))
    left_out = torch.stack([mean(every[every != i]) for i in every])
    return mean(every), ((len(every) - 1) * left_out.var(0, correction=0)).sqrt()


def held(found, errors, fresh):
    """Shares of fresh energies within one error of both, and their errors, (part, window); every pair of different seeds."""
    inside = torch.zeros(len(found), len(fresh), 2, len(WINDOWS), dtype=torch.float64)
    times, own = TIMES, OWN.expand(B, len(TIMES), B)
    for i, j in np.ndindex(*inside.shape[:2]):
        error = errors[i].square() + fresh[j].stderr.square()
        within = ((found[i] - fresh[j].mean).square() <= error).double()
        for w, (low, high) in enumerate(WINDOWS):
            here = (times > low) & (times <= high)
            inside[i, j, :, w] = torch.stack([within[:, here][part[:, here]].mean() for part in (own, ~own)])
    return over_pairs(inside)


def test_energies_of_two_ensembles_lie_within_one_error_as_often_as_normal_ones(ensembles):
    share, error = held([each.mean for each in ensembles], [each.stderr for each in ensembles], ensembles)
    assert float(error.max()) < 0.1
    assert bool(((share - 0.683).abs() < 0.03 + 3 * error).all()), (share, error)


def test_energies_of_fresh_chains_lie_within_one_error_of_a_model(ensembles):
    """In every window, for the source's own band and for others: 60 to 76 % are wanted, the error of the share aside."""
    masters = [tc.calibrate(each) for each in ensembles]
    errors = [each.standard_error(torch.eye(B, dtype=torch.float64), TIMES) for each in masters]
    share, error = held([each.transfer(TIMES) for each in masters], errors, ensembles)
    assert float(error.max()) < 0.08
    assert bool(((share - 0.68).abs() < 0.08 + 2 * error).all()), (share, error)
    narrow, _ = held([each.transfer(TIMES) for each in masters], [each / 3 for each in errors], ensembles)
    assert bool((narrow < share - 0.05).all())  # the shares do tell of the errors


def test_energies_of_mixtures_of_bands_lie_within_one_error_as_often(ensembles):
    """Neighboring bands err alike, so that their mixture errs more than by independent errors, and all bands together less."""
    starts = torch.cat([torch.ones(1, B), torch.ones(B, B).triu().tril(2)[: B - 2]]).double()
    starts = starts / starts.sum(-1, keepdim=True)
    masters = [tc.calibrate(each) for each in ensembles]
    found, errors = zip(*((m.solve(starts, TIMES), m.standard_error(starts, TIMES)) for m in masters), strict=True)
    measured = []
    for each in ensembles:
        blocks = torch.einsum("ms,bstr->bmtr", starts, each.block_mean.double())
        measured.append((blocks.mean(0), blocks.std(0) / len(blocks) ** 0.5))
    inside = torch.zeros(len(masters), len(masters), len(WINDOWS), dtype=torch.float64)
    for i, j in np.ndindex(*inside.shape[:2]):
        mean, stderr = measured[j]
        inside[i, j] = windows(((found[i] - mean).square() <= errors[i].square() + stderr.square()).double())
    share, error = over_pairs(inside)
    assert float(error.max()) < 0.08
    assert bool(((share - 0.68).abs() < 0.08 + 2 * error).all()), (share, error)


def test_between_the_members_of_a_family_they_hold_as_often(ensembles):
    count = 8
    members = ([ensemble(seed, strength) for strength in (0.1, 0.2, 0.4)] for seed in SEEDS[:count])
    masters = [tc.calibrate_family(each).at(0.3) for each in members]
    errors = [each.standard_error(torch.eye(B, dtype=torch.float64), TIMES) for each in masters]
    share, error = held([each.transfer(TIMES) for each in masters], errors, ensembles[:count])
    later, error = share[:, 1:], error[:, 1:]
    assert float(error.max()) < 0.06
    assert bool(((later - 0.68).abs() < 0.08 + 2 * error).all()), (share, error)
    assert float(share[:, 0].min()) > 0.4  # 0.47 up to t = 1 with three members and chains as short as this


def test_one_fit_of_twenty_that_went_astray_does_not_count_for_all():
    values = torch.randn(20, 4000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    plain, off = winsorized(values)
    torch.testing.assert_close(off.std(0), plain)
    torch.testing.assert_close(off.mean(0), torch.zeros(4000).double(), rtol=0, atol=1e-12)
    assert abs(float(plain.square().mean()) - 1) < 0.05  # of normal values next to nothing is cut
    assert float(((plain - values.std(0)).abs() > 1e-12).double().mean()) < 0.3
    values[3] = 1e6
    assert float(winsorized(values)[0].square().mean()) < 2
    assert torch.equal(winsorized(torch.ones(5, 3))[0], torch.zeros(3))


def test_noise_and_misfit_are_told_apart_at_all_times(tmp_path):
    n, times = 3, torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    draw = torch.Generator().manual_seed(2)
    noise, misfit = torch.rand(2, n, 3, n, generator=draw, dtype=torch.float64)
    errors = of_parts(torch.ones(n, n), torch.ones(n, n), times, noise, misfit)
    found = errors.parts(times)
    own = torch.eye(n, dtype=torch.bool)[:, None].expand_as(noise)
    torch.testing.assert_close(sum(found), noise + misfit, rtol=1e-6, atol=0)
    torch.testing.assert_close(found[1][own], misfit[own], rtol=1e-5, atol=0)
    shares = (misfit / (noise + misfit))[~own].reshape(-1, 2)  # of others the mean share is kept
    assert float(errors.misfit_share[1].mean()) == pytest.approx(float(shares.mean()), rel=1e-5)
    older = replace(errors, misfit_share=None)
    assert float(older.parts(times)[1].max()) == 0
    for each in (errors, older):
        again = Uncertainty.from_tensors(**each.tensors())
        assert torch.equal(again.stderr, errors.stderr)
    with pytest.raises(FieldError, match="misfit_share must be at most 1"):
        Uncertainty.from_tensors(**errors.tensors() | {"misfit_share": errors.misfit_share + 1})
    with pytest.raises(FieldError, match="misfit_share must have shape"):
        Uncertainty.from_tensors(**errors.tensors() | {"misfit_share": errors.misfit_share[:1]})


def test_factors_are_those_of_errors_that_were_made_with_them():
    n, count, replicas = 5, 16, 4000
    draw = torch.Generator().manual_seed(3)
    part = torch.tensor([0.9, 0.8, 0.0, -0.7, 0.5], dtype=torch.float64)
    common = torch.randn(replicas, 1, count, n, generator=draw, dtype=torch.float64)
    alone = torch.randn(replicas, n, count, n, generator=draw, dtype=torch.float64)
    error = torch.rand(n, count, n, generator=draw, dtype=torch.float64) + 0.5
    sources = part[None, :, None, None]
    spread = error * (sources * common + (1 - sources.square()).sqrt() * alone)
    found = factors(spread, torch.zeros_like(spread), torch.zeros_like(error), error)
    assert found.shape == (2, n, 8, n)
    assert float(found.square().sum(0).max()) <= 1 + 1e-12
    shared = torch.einsum("fsgr,fugr->sugr", found, found)
    for s, u in ((0, 1), (0, 3), (1, 4), (3, 4)):
        assert abs(float(shared[s, u].mean() - part[s] * part[u])) < 0.2  # what each has for itself is not quite apart
    start = torch.tensor([0.5, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64)
    times = torch.arange(count, dtype=torch.float64)
    errors = of_parts(error[:, 0], error[:, 0], times, error.square(), 0 * error, found)
    made = torch.einsum("s,kstr->ktr", start, spread).std(0)
    told, apart = errors.of(start, times), replace(errors, alike=None).of(start, times)
    assert float((told / made - 1).abs().max()) < 0.1
    assert float((apart / made).max()) < 0.85


def test_damaged_factors(ensembles):
    errors = tc.calibrate(ensembles[0], model="compact").uncertainty
    with pytest.raises(FieldError, match="alike must hold parts of squares up to 1"):
        Uncertainty.from_tensors(**errors.tensors() | {"alike": errors.alike + 1})
    with pytest.raises(FieldError, match="alike must have shape"):
        Uncertainty.from_tensors(**errors.tensors() | {"alike": errors.alike[:, :, :1]})


def test_files_without_the_share_of_misfit_are_read(ensembles, tmp_path):
    from safetensors import safe_open
    from safetensors.torch import save_file

    master = tc.calibrate(ensembles[0], model="compact")
    master.save(tmp_path / "new.safetensors")
    with safe_open(tmp_path / "new.safetensors", "pt") as file:
        header, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    share, _ = tensors.pop("misfit_share"), tensors.pop("alike")
    save_file(tensors, tmp_path / "old.safetensors", header)
    old = tc.MasterEquation.load(tmp_path / "old.safetensors")
    assert old.uncertainty.misfit_share is old.uncertainty.alike is None
    start = torch.eye(B, dtype=torch.float64)
    torch.testing.assert_close(old.standard_error(start, TIMES), master.standard_error(start, TIMES), rtol=1e-6, atol=0)
    assert torch.equal(tc.MasterEquation.load(tmp_path / "new.safetensors").uncertainty.misfit_share, share)
    save_file({"misfit_share": share}, tmp_path / "bad.safetensors", header)
    with pytest.raises(FieldError, match="must hold the tensors"):
        tc.MasterEquation.load(tmp_path / "bad.safetensors")


def test_more_chains_lessen_noise_and_not_misfit():
    """Where an ensemble is large, the rest is what models of this form miss; between strengths it is not averaged away."""
    scenes = [
        tc.Scene(n_particles=48, n_bands=B, realizations=60, seed=5, times=TIMES, disorder=tc.Disorder(strength=xi))
        for xi in (0.2, 0.3)
    ]
    family = tc.calibrate_family([tc.band_transfer(scene, method="modes", starts=False) for scene in scenes])
    between = family.at(math.sqrt(0.06)).uncertainty
    sides = [member.uncertainty for member in family.members]
    found, (low, high) = between.parts(TIMES), (each.parts(TIMES) for each in sides)
    assert float(found[1].sqrt().mean()) > 0.9 * float((low[1].sqrt().mean() + high[1].sqrt().mean()) / 2)
    assert float(found[0].mean()) < 0.75 * float((low[0].mean() + high[0].mean()) / 2)
