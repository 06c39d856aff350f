"""Block means of large transfers are rounded below their noise: sums, error bars and files."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
import xarray

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.cli import outputs
from torchchain.ensemble import block_means

N, TIMES, REALIZATIONS = 16, torch.linspace(0, 51, 205, dtype=torch.float64), 23


def energies(lost):
    """Shares of the energy that wander in time, with noise of very unlike sizes; a part ``lost`` of each is missing."""
    draw = torch.Generator().manual_seed(3)
    shape = (REALIZATIONS, N, len(TIMES), N)
    steps = torch.randn(shape, generator=draw, dtype=torch.float64)
    wander = torch.cumsum(steps, 2) / torch.arange(1, len(TIMES) + 1).sqrt()[:, None]
    weight = (
        torch.exp(-torch.arange(N)[None, :].sub(torch.arange(N)[:, None]).abs().double()) * (TIMES > 0)[:, None, None]
    )
    shares = torch.eye(N, dtype=torch.float64)[:, None] + 0.1 * weight.movedim(0, 1) * wander
    shares = shares / shares.sum(-1, keepdim=True)
    return shares * (1 - lost * torch.rand(shape[:3], generator=draw, dtype=torch.float64))[..., None]


@pytest.fixture(scope="module", params=[0.0, 0.3], ids=["conserved", "lossy"])
def transfers(request):
    """A transfer as it comes, and with its blocks kept whole."""
    given = energies(request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_means, "LARGE", 2**40)
        whole = tc.BandTransfer.from_energies(TIMES, given)
    return tc.BandTransfer.from_energies(TIMES, given), whole, request.param


def test_rounding_is_far_below_the_noise(transfers):
    found, whole, _ = transfers
    assert torch.equal(found.mean, whole.mean)
    assert torch.equal(found.long_time, whole.long_time)
    assert not torch.equal(found.block_mean, whole.block_mean)
    torch.testing.assert_close(found.stderr, whole.stderr, rtol=2.0**-12, atol=0)
    spread = whole.stderr * len(whole.block_counts) ** 0.5
    moved = (found.block_mean - whole.block_mean)[:-1]  # a deviation and what the one before it left
    noisiest = torch.nn.functional.one_hot(found.stderr.argmax(-1), N).bool()
    assert float((moved / (spread / 6 + 1e-11)).abs()[:, ~noisiest].max()) <= 1
    later = (found.block_mean - whole.block_mean)[:, :, 1:] / spread[:, 1:]
    assert float(later.square().mean()) < 0.01


def test_sums_are_kept(transfers):
    found, whole, lost = transfers
    weights = torch.tensor(found.block_counts, dtype=torch.float64) / REALIZATIONS
    torch.testing.assert_close(torch.einsum("b,bstr->str", weights, found.block_mean), found.mean, rtol=0, atol=1e-14)
    missing = (found.block_mean - whole.block_mean).sum(-1)[:-1]
    if lost:  # in units of 1 / 64 of the noisiest receiver's
        largest = (whole.stderr * len(whole.block_counts) ** 0.5 / 6).amax(-1)
        assert float((missing.abs() / (largest / 128 + 1e-14)).max()) <= 1
    else:
        assert float(missing.abs().max()) < 1e-14


def test_a_file_holds_small_integers_and_gives_back_every_bit(transfers, tmp_path):
    found, whole, _ = transfers
    found.save(tmp_path / "t.nc")
    again = tc.BandTransfer.load(tmp_path / "t.nc")
    assert torch.equal(again.block_mean, found.block_mean)
    assert torch.equal(again.stderr, found.stderr)
    assert again.to_dataset()["block_steps"].dtype.itemsize <= 2
    assert (tmp_path / "t.nc").stat().st_size < found.block_mean.numel() * 3
    # Blocks of anybody's own are kept as they are.
    own = replace(found, block_mean=whole.block_mean)
    assert torch.equal(tc.BandTransfer.from_dataset(own.to_dataset()).block_mean, whole.block_mean)


def test_what_is_small_is_kept_whole(small_transfer):
    assert "block_band_energy" in small_transfer.to_dataset()
    given = energies(0.0)[:, :, :40]
    found = tc.BandTransfer.from_energies(TIMES[:40], given)
    torch.testing.assert_close(found.block_mean[0], given[:1].mean(0), rtol=1e-14, atol=1e-15)


def test_steps_that_are_none(transfers):
    data = transfers[0].to_dataset()
    with pytest.raises(FieldTypeError, match="data.block_steps must be of integers, got float64"):
        tc.BandTransfer.from_dataset(data.assign(block_steps=data["block_steps"] * 1.0))
    shorter = data.assign(block_steps=(("block", "source", "time", "half"), data["block_steps"].values[..., :8]))
    with pytest.raises(FieldError, match=r"data.block_steps must have shape \(20, 16, 205, 16\)"):
        tc.BandTransfer.from_dataset(shorter)


def test_single_realizations_and_ordered_chains_have_no_noise_to_round():
    single = energies(0.0)[:1].expand(1, -1, -1, -1)
    counts, mean = (1,) * 20, single[0]
    same = mean.expand(20, *mean.shape)
    kept, _ = block_means.rounded(same, mean, torch.zeros_like(mean), counts)
    assert torch.equal(kept, same)
    endless = torch.full_like(mean, torch.inf)
    kept, stderr = block_means.rounded(same, mean, endless, counts)
    assert torch.equal(kept, same)
    assert torch.equal(stderr, endless)
    assert np.array_equal(block_means.encoded(kept, mean, endless, counts), np.zeros(kept.shape))


def test_files_hold_large_values_over_time_time_after_time(tmp_path):
    """They change little from one to the next: less room, and the same numbers. Few values are left alone."""
    walk = np.random.default_rng(0).normal(size=(40, 100, 30)).cumsum(1).round(2)
    axes = ("source", "time", "receiver")
    data = xarray.Dataset({"large": (axes, walk), "other": (("source", "place", "receiver"), walk)})
    data["small"] = data["large"][0]
    outputs.dataset(data)(tmp_path / "data.nc")
    with h5py.File(tmp_path / "data.nc") as file:
        assert file["large"].chunks == (40, 100, 1)
        assert file["small"].chunks != (100, 1)
        assert file["large"].id.get_storage_size() < 0.9 * file["other"].id.get_storage_size()
    with xarray.open_dataset(tmp_path / "data.nc", engine="h5netcdf") as found:
        for name in data:
            np.testing.assert_array_equal(found[name], data[name])
