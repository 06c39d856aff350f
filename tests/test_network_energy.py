"""Where the energy of networks is: in space, over wavevectors, in shell bands; spectra; the golden rule."""

import math

import pytest
import torch

import torchchain as tc
from torchchain import network as nw
from torchchain.checks import FieldError

F64 = torch.float64
SHAPES = {"chain": (12,), "square": (6, 6), "triangular": (6, 8), "fcc": (4, 5, 4)}
LINEAR = torch.linspace(0, 40, 21, dtype=F64)


def disordered(kind, boundary="periodic"):
    motion = "scalar" if kind == "square" else "vector"
    ordered = nw.lattice(kind, SHAPES[kind], motion, boundary)
    return nw.disordered(ordered, tc.Disorder(strength=0.2), tc.Disorder(strength=0.1), 2, 3)


def random_path(network, seed=0):
    g = torch.Generator().manual_seed(seed)
    shape = (*network.batch_shape, network.n_particles, network.n_components)
    u, v = (torch.randn(shape, generator=g, dtype=F64) for _ in range(2))
    return nw.evolve(network, tc.State(u, v), LINEAR)


@pytest.mark.parametrize("boundary", ["periodic", "fixed", "free"])
@pytest.mark.parametrize("kind", SHAPES)
def test_energies_of_particles_add_up(kind, boundary):
    network = disordered(kind, boundary)
    path = random_path(network)
    total = nw.total_energy(network, path)
    torch.testing.assert_close(total, total[:, :1].expand_as(total), rtol=1e-12, atol=0)
    for definition in ("bond", "site"):
        energy = nw.particle_energy(network, path, definition)
        torch.testing.assert_close(energy.sum(-1), total, rtol=1e-13, atol=0)
    assert bool((nw.particle_energy(network, path) >= 0).all())
    assert bool((nw.bond_energy(network, path) >= 0).all())


@pytest.mark.parametrize("kind", SHAPES)
def test_energies_of_wavevectors_add_up(kind):
    network = disordered(kind)
    path = random_path(network)
    energy = nw.wavenumber_energy(network, path)
    torch.testing.assert_close(energy.sum((-2, -1)), nw.total_energy(network, path), rtol=1e-12, atol=0)
    n_bands = 2 * energy.shape[-1]
    bands = nw.band_energy(network, path, n_bands, normalize=False)
    assert bands.shape[-1] == len(nw.shell_bands(network, n_bands).labels)
    # Each band for itself: of the energies of all wavevectors, whose transform is a complex one, summed over shells.
    edges = nw.shell_bands(network, n_bands).edges
    shells = nw.shell_energy(nw.zone(network).lengths, energy, edges).transpose(-2, -1).flatten(-2)
    torch.testing.assert_close(bands, shells, rtol=0, atol=1e-13 * float(energy.sum((-2, -1)).max()))
    torch.testing.assert_close(bands.sum(-1) + energy[..., 0, :].sum(-1), energy.sum((-2, -1)), rtol=1e-12, atol=0)


@pytest.mark.parametrize("kind", SHAPES)
def test_zone_is_the_first(kind):
    where = nw.zone(nw.lattice(kind, SHAPES[kind], "scalar"))
    q = where.wavevectors
    assert where.lengths.max() <= nw.shell_bands(nw.lattice(kind, SHAPES[kind], "scalar"), 1).edges[-1] * (1 + 1e-12)
    torch.testing.assert_close(q.norm(dim=-1), where.lengths)
    assert bool(((where.longitudinal.diagonal(dim1=-2, dim2=-1).sum(-1) - 1).abs() < 1e-12).all())


@pytest.mark.parametrize("kind", SHAPES)
def test_band_waves_are_pure_and_long_times_are_averages(kind):
    network = disordered(kind)
    n_bands = 2 if network.n_components == 1 else 4
    waves = nw.band_waves(network, n_bands)
    start = nw.band_energy(network, nw.evolve(network, waves.state, [0.0]), n_bands)[:, :, 0]
    # Strained at one wavevector alone: u_q is zero at all others, whatever the bonds make of it.
    torch.testing.assert_close(start, torch.eye(n_bands, dtype=F64).expand_as(start), rtol=0, atol=1e-12)
    g = torch.Generator().manual_seed(0)
    times = torch.rand(1500, generator=g, dtype=F64).sort().values * 1e6
    seen = nw.band_energy(network, nw.evolve(network, waves.state, times), n_bands)
    mean, error = seen.mean(-2), seen.std(-2) / len(times) ** 0.5
    expected = nw.long_time_band_energy(network, waves.state, n_bands)
    assert bool(((mean - expected).abs() < 5 * error + 1e-12).all())
    torch.testing.assert_close(expected.sum(-1) <= 1 + 1e-12, torch.ones_like(expected[..., 0], dtype=torch.bool))


def test_long_time_average_of_degenerate_modes_keeps_their_phases():
    # In an ordered lattice a wave along a bond is one mode of many of its frequency and stays what it is.
    network = nw.lattice("triangular", (8, 8))
    for polarization, band in (("longitudinal", 0), ("transverse", 2)):
        wave = nw.plane_wave(network, (2, 1), polarization)
        share = nw.long_time_band_energy(network, wave, 4)
        assert abs(share[band] - 1) < 1e-10
    drift = tc.State(torch.zeros(64, 2, dtype=F64), torch.ones(64, 2, dtype=F64))
    assert nw.long_time_band_energy(network, drift, 4).abs().max() < 1e-12


def test_spreading_of_a_kick():
    network = nw.lattice("triangular", (40, 40), boundary="fixed")
    site = 20 * 40 + 20
    kick = torch.zeros(1600, 2, dtype=F64)
    kick[site, 0] = 1.0
    path = nw.evolve(network, tc.State(torch.zeros_like(kick), kick), [0.0, 4.0, 8.0, 16.0], "chebyshev")
    energy = nw.particle_energy(network, path)
    radius, spread, front = (
        f(network, energy, site + 1) for f in (nw.energy_radius, nw.energy_spread, nw.energy_front)
    )
    assert radius[0] == spread[0] == front[0] == 0
    # The energy moves at a mean squared velocity: r^2 grows as t^2, and no faster than the fastest sound, c_L^2 = 9 / 8.
    assert abs(spread[3] / spread[2] / 4 - 1) < 0.1
    assert bool((front[1:] < math.sqrt(9 / 8) * path.times[1:] + 2).all())
    rings = nw.radial_profile(network, energy, site + 1, torch.linspace(0, 40, 21))
    torch.testing.assert_close(rings.sum(-1), energy.sum(-1), rtol=1e-12, atol=0)
    assert nw.distances(network, network.positions[site].tolist())[site] == 0
    with pytest.raises(FieldError, match="origin must be at most 1600"):
        nw.distances(network, 1601)


def test_distances_cross_the_box():
    network = nw.lattice("triangular", (6, 6))
    assert nw.distances(network, 1).max() <= 6 / math.sqrt(3) + 1e-12  # from the corner to the middle of a triangle
    assert (nw.distances(network, 1) < 1.001).sum() == 7


def test_plane_waves_of_a_packing_and_their_remainder():
    ordered = nw.lattice("triangular", (8, 8))
    moved = nw.displaced(ordered, 0.05, seed=1)
    masses = tc.Disorder(strength=0.2).masses(64, 2, 1)
    network = nw.Network(masses, moved.positions, moved.bonds, box=moved.box, images=moved.images)
    path = random_path(network)
    found = nw.plane_wave_energy(network, path, 2.0)
    total = nw.total_energy(network, path)
    torch.testing.assert_close(found.energy.sum((-2, -1)) + found.remainder, total, rtol=1e-12, atol=0)
    assert bool((found.remainder > 0.3 * total).all())  # random states are mostly short waves
    q = found.wavevectors[3]
    wave = (network.positions @ q).cos()[:, None] * q / q.norm()
    single = tc.State(0 * wave.expand(2, -1, -1), wave.expand(2, -1, -1))
    found = nw.plane_wave_energy(network, nw.evolve(network, single, [0.0]), 2.0)
    share = found.energy[:, 0] / nw.total_energy(network, nw.evolve(network, single, [0.0]))[:, :1, None]
    assert bool((share[:, 3, 0] > 0.95).all())  # moved masses blur it a little
    assert bool((found.remainder.abs() < 1e-12).all())
    with pytest.raises(FieldError, match="largest wavenumber must leave at most 128 waves"):
        nw.plane_wave_energy(network, path, 6.0)


def test_plane_waves_on_a_lattice_are_its_fourier_transform():
    network = nw.lattice("triangular", (7, 9))
    path = random_path(network)
    where, energy = nw.zone(network), nw.wavenumber_energy(network, path)
    found = nw.plane_wave_energy(network, path, 2.0)
    for k, q in enumerate(found.wavevectors):
        same = ((where.wavevectors - q).norm(dim=-1) < 1e-9) | ((where.wavevectors + q).norm(dim=-1) < 1e-9)
        torch.testing.assert_close(energy[:, same].sum(-2), found.energy[:, k], rtol=1e-10, atol=1e-10)


def test_density_of_states_by_moments():
    network = nw.disordered(nw.lattice("triangular", (20, 20)), tc.Disorder(strength=0.2), realizations=[4], seed=1)
    one = nw.disordered(nw.lattice("triangular", (20, 20)), tc.Disorder(strength=0.2), realizations=[4], seed=1)
    one = nw.Lattice(
        **{k: getattr(one, k) for k in ("positions", "bonds", "box", "images", "kind", "shape", "boundary", "steps")},
        masses=one.masses[0],
    )
    w = torch.linspace(0, 3.5, 1401, dtype=F64)
    found = nw.density_of_states(one, w, n_moments=100, n_starts=40, seed=2)
    assert abs(torch.trapezoid(found.density, w) - 1) < 1e-3
    frequencies = nw.normal_modes(network).frequencies[0]
    for low, high in ((0.0, 1.0), (1.0, 2.0), (2.0, 3.5)):
        inside = (w >= low) & (w <= high)
        share = torch.trapezoid(found.density[inside], w[inside]).item()
        counted = ((frequencies >= low) & (frequencies < high)).double().mean().item()
        assert abs(share - counted) < 0.02  # the kernel blurs the edges by pi W / 100 = 0.1, and g is 0.5 there at most


def test_moments_by_kernels_and_by_torch(monkeypatch):
    from torchchain.network import layouts
    from torchchain.network.spectra import _plain_moments

    monkeypatch.setattr(layouts, "NARROW", 0)  # by rows, however short

    network = nw.lattice("fcc", (4, 4, 5))
    g = torch.Generator().manual_seed(0)
    starts = torch.randn(2, 80, 3, generator=g, dtype=F64)
    moments, top = nw.spectral_moments(network, starts, 40)
    unit = starts / starts.square().sum((-2, -1), keepdim=True).sqrt()
    torch.testing.assert_close(moments, _plain_moments(network, unit, 40, top), rtol=0, atol=1e-12)
    gathered = nw.Network(network.masses, network.positions, network.bonds, box=network.box, images=network.images)
    other, wider = nw.spectral_moments(gathered, starts, 40)
    torch.testing.assert_close(other, _plain_moments(gathered, unit, 40, wider), rtol=0, atol=1e-12)


def test_structure_factor_peaks_at_the_dispersion():
    network = nw.lattice("triangular", (24, 24))
    w = torch.linspace(0, 2.6, 1301, dtype=F64)
    for polarization, law in (
        ("longitudinal", lambda q: 3 - 2 * math.cos(q) - math.cos(q / 2)),
        ("transverse", lambda q: 3 * (1 - math.cos(q / 2))),
    ):
        turns = [[4, 2], [8, 4]]
        found = nw.structure_factor(network, turns, w, polarization, n_moments=400)
        for k, (m, _) in enumerate(turns):
            expected = math.sqrt(law(2 * math.pi * m / 24))
            assert abs(w[found.density[k].argmax()] - expected) < 0.01  # half of the resolution pi W / n_moments
        torch.testing.assert_close(torch.trapezoid(found.density, w), torch.ones(2, dtype=F64), rtol=0, atol=2e-2)


def test_ordered_density_of_states_is_sounds_at_low_frequency():
    # g -> (w / 2 pi) (area per particle) (1 / c_L^2 + 1 / c_T^2) / 2 in two dimensions, c_L^2 = 9 / 8, c_T^2 = 3 / 8.
    g = nw.ordered_density(nw.lattice("triangular", (3, 3)), [0.0, 0.2], 400)
    debye = 0.1 / (2 * math.pi) * math.sqrt(0.75) * (8 / 9 + 8 / 3) / 2
    assert abs(g[0] / debye - 1) < 0.02
    # The whole band of the square lattice, scalar: w from 0 to sqrt(8).
    assert abs(nw.ordered_density(nw.lattice("square", (3, 3), "scalar"), [0.0, 8**0.5], 200)[0] * 8**0.5 - 1) < 1e-12


def test_a_plane_wave_decays_by_the_golden_rule():
    # Waves along the three bonds of a triangular lattice, sine and cosine, in one lattice at xi = 0.2.
    size, m, xi = 100, 7, 0.2
    ordered = nw.lattice("triangular", (size, size))
    turns = [(2 * m, m), (-m, -2 * m), (m, -m)]
    waves = torch.stack(
        [nw.plane_wave(ordered, t, "longitudinal", 1.0, p).displacement for t in turns for p in ("sin", "cos")]
    )
    q = 4 * math.pi * m / size
    w = math.sqrt(3 - 2 * math.cos(q) - math.cos(q / 2))
    born = nw.born_rate(ordered, [w], xi, points=600).item()
    network = nw.disordered(ordered, tc.Disorder(kind="uniform", strength=xi), realizations=1, seed=1)
    times = torch.linspace(0.1, 1.0, 12, dtype=F64) / born
    path = nw.evolve(network, tc.State(waves[None], torch.zeros_like(waves)[None]), times, "chebyshev", accuracy=1e-6)
    dual = (waves / waves.square().sum((-2, -1), keepdim=True))[:, None]
    along, speed = ((x * dual).sum((-2, -1)) for x in (path.displacement, path.velocity))
    energy = (along.square() + speed.square() / w**2)[0]

    def rate(mean):
        t = times - times.mean()
        return -((t * mean.log()).sum() / t.square().sum()).item()

    measured = rate(energy.mean(0))
    left_out = torch.tensor([rate(energy[torch.arange(6) != i].mean(0)) for i in range(6)])
    error = math.sqrt(5 / 6 * (left_out - left_out.mean()).square().sum())
    assert error < 0.1 * born
    assert abs(measured - born) < 0.1 * born + 2 * error
