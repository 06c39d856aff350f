"""A band transfer as a thing of its own: data of any origin, files, and what it prints."""

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.ensemble.provenance import Provenance

TIMES = torch.arange(0.0, 40.0, 0.5, dtype=torch.float64)
FIELDS = ("times", "mean", "stderr", "long_time", "long_time_stderr", "block_mean", "block_long_time")


def energies(realizations=30, seed=0):
    """Two bands that exchange energy at a rate that differs between realizations, around 0.5."""
    draw = torch.Generator().manual_seed(seed)
    rate = 0.5 + 0.1 * torch.rand(realizations, 1, generator=draw, dtype=torch.float64)
    kept = 0.6 + 0.4 * torch.exp(-rate * TIMES)
    return torch.stack([torch.stack([kept, 1 - kept], -1), torch.stack([1 - kept, kept], -1)], 1)


def test_means_errors_and_blocks_are_those_of_the_realizations():
    given = energies()
    found = tc.BandTransfer.from_energies(TIMES, given, provenance="two bands")
    torch.testing.assert_close(found.mean, given.mean(0), rtol=1e-13, atol=1e-15)
    torch.testing.assert_close(found.stderr, given.std(0) / 30**0.5, rtol=1e-9, atol=1e-15)
    weights = torch.tensor(found.block_counts, dtype=torch.float64) / 30
    torch.testing.assert_close(torch.einsum("b,b...->...", weights, found.block_mean), found.mean)
    assert (found.scene, found.n_bands, found.damping, found.is_ordered) == (None, 2, 0.0, False)
    assert (found.provenance.kind, found.provenance.words) == ("imported", "two bands")
    assert len(found.provenance.hashes["energies"]) == 64


def test_the_long_time_average_is_of_the_later_half_with_an_error_that_covers_what_has_not_settled():
    found = tc.BandTransfer.from_energies(TIMES, energies())
    assert float((found.long_time - torch.tensor([[0.6, 0.4], [0.4, 0.6]])).abs().max()) < 1e-3
    assert float(found.long_time_stderr.max()) < 1e-3
    early = TIMES <= 4  # still decaying
    found = tc.BandTransfer.from_energies(TIMES[early], energies()[:, :, early])
    off = (found.long_time - torch.tensor([[0.6, 0.4], [0.4, 0.6]])).abs().max()
    assert float(off) < 4 * float(found.long_time_stderr.max())


def test_a_known_long_time_average_is_kept():
    exact = torch.tensor([[0.6, 0.4], [0.4, 0.6]], dtype=torch.float64)
    found = tc.BandTransfer.from_energies(TIMES, energies(), long_time=exact)
    torch.testing.assert_close(found.long_time, exact)
    assert not found.long_time_stderr.any()
    each = exact + 0.01 * torch.randn(30, 2, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = tc.BandTransfer.from_energies(TIMES, energies(), long_time=each)
    torch.testing.assert_close(found.long_time_stderr, each.std(0) / 30**0.5)


def test_simulated_energies_give_the_simulated_transfer(small_scene, small_transfer):
    chain = small_scene.chain(range(12))
    trajectory = tc.evolve(chain, small_scene.state(chain), small_scene.times)
    found = tc.BandTransfer.from_energies(small_scene.times, tc.band_energy(chain, trajectory, 4))
    torch.testing.assert_close(found.mean, small_transfer.mean, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(found.stderr, small_transfer.stderr, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("origin", ["imported", "simulated"])
def test_saved_and_loaded(origin, tmp_path, small_transfer):
    given = (
        small_transfer if origin == "simulated" else tc.BandTransfer.from_energies(TIMES, energies(), provenance="x")
    )
    given.save(tmp_path / "t.nc")
    found = tc.BandTransfer.load(tmp_path / "t.nc")
    assert all(torch.equal(getattr(found, name), getattr(given, name)) for name in FIELDS)
    assert found.provenance == given.provenance
    assert found.provenance.kind == origin
    assert found.block_counts == given.block_counts
    assert [path.name for path in tmp_path.iterdir()] == ["t.nc"]


def test_what_is_no_file_of_a_transfer(tmp_path, small_transfer):
    with pytest.raises(FieldError, match="path must be a band transfer's netCDF file, got .*none.nc: .*No such file"):
        tc.BandTransfer.load(tmp_path / "none.nc")
    (tmp_path / "text.nc").write_text("text")
    with pytest.raises(FieldError, match="path must be a band transfer's netCDF file"):
        tc.BandTransfer.load(tmp_path / "text.nc")
    with pytest.raises(FieldError, match="path must be writable"):
        small_transfer.save(tmp_path / "no" / "folder.nc")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e[0], r"energies must have the axes \(realization, source, time, receiver\) with 80 times"),
        (lambda e: e[:, :, 1:], "energies must have the axes .* with 80 times"),
        (lambda e: e[..., :1], "energies must have the axes"),
        (lambda e: e[:0], "energies must hold at least one realization"),
        (lambda e: e * torch.nan, "energies must be finite"),
    ],
)
def test_energies_that_are_none(change, message):
    with pytest.raises(FieldError, match=message):
        tc.BandTransfer.from_energies(TIMES, change(energies()))


def test_other_bad_arguments():
    with pytest.raises(FieldError, match=r"long_time must have shape \(2, 2\) or \(30, 2, 2\)"):
        tc.BandTransfer.from_energies(TIMES, energies(), long_time=np.zeros((3, 3)))
    with pytest.raises(FieldTypeError, match="provenance must be a str"):
        tc.BandTransfer.from_energies(TIMES, energies(), provenance=3)
    with pytest.raises(FieldTypeError, match="provenance.words must be a str"):
        Provenance(words=3)


def test_records_print_in_few_lines(small_scene, small_transfer):
    for record in (
        small_scene,
        small_transfer,
        tc.BandTransfer.from_energies(TIMES, energies(), provenance="two bands"),
    ):
        assert 6 <= len(repr(record).splitlines()) <= 10
        assert max(map(len, repr(record).splitlines())) <= 120
        assert record._repr_html_().count("<tr>") == len(repr(record).splitlines()) - 1
    assert "two bands" in repr(tc.BandTransfer.from_energies(TIMES, energies(), provenance="two bands"))
