"""CPU against GPU, where there is one."""

import pytest
import torch

import torchchain as tc

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def scene():
    return tc.Scene(n_particles=64, n_bands=8, realizations=6, times=torch.arange(0.0, 20.0, 1.0))


def test_masses_are_the_same_bits():
    assert torch.equal(scene().chain(range(6), "cuda").masses.cpu(), scene().chain(range(6)).masses)


@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet", "symplectic4"])
def test_states_agree(method):
    options = {"step": 0.02} if method in ("verlet", "symplectic4") else {}
    paths = []
    for device in ("cpu", "cuda"):
        chain = scene().chain(range(6), device)
        paths.append(tc.evolve(chain, scene().state(chain), scene().times, method, **options).displacement.cpu())
    torch.testing.assert_close(paths[0], paths[1], rtol=0, atol=1e-12)


def test_band_transfer_agrees():
    cpu, gpu = (tc.band_transfer(scene(), "modes", device=device) for device in ("cpu", "cuda"))
    torch.testing.assert_close(cpu.mean, gpu.mean, rtol=0, atol=1e-11)
    torch.testing.assert_close(cpu.long_time, gpu.long_time, rtol=0, atol=1e-11)


def test_master_equation_solves_there():
    master = tc.calibrate(tc.band_transfer(scene()))
    start = torch.eye(8, dtype=torch.float64)
    here = master.solve(start, scene().times)
    torch.testing.assert_close(master.to("cuda").solve(start, scene().times).cpu(), here, rtol=0, atol=1e-12)
