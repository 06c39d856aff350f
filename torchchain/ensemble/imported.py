"""Runs of any code, gathered into what a band transfer is made of: band energies, starts, and which runs share a chain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy.bands import check_bands
from torchchain.energy.wavenumber import band_energy, long_time_band_energy
from torchchain.frames import check_energy
from torchchain.frames.doubts import warn
from torchchain.network import Network, NetworkTrajectory, PackingBands, packing_band_energy, packing_bands

PURE = 0.99
"""Share of the energy in one band from which a run counts as one that starts in it alone."""
ABSENT = 0.02
"""Share in its own band below which a source is taken for another one's: sources in a wrong order."""
SAME = 1e-3
"""Share by which the stiffness of a contact may differ between two runs of one chain."""
NOISE, LOSS = 0.01, 0.2
"""Shares by which the energies of a run may sum up to more than 1, and lose what they began with, before a warning."""
OUTSIDE = 0.1
"""Share of the energy that may be in no band, as that of the motion as a whole is, before a warning; 4 / N in short chains."""


def as_shares(times: Tensor, energies: Tensor) -> Tensor:
    """Energies that someone gives, checked to be shares of the energy of each run, and at most 1 together.

    Args:
        times: (time,).
        energies: (realization, source, time, receiver).

    Returns:
        The same; what sums up to more than 1 by the noise of a measurement is scaled to 1.

    Raises:
        FieldError: for energies in other units or of no size, that grow, or that start in another band.

    Warns:
        FramesWarning: for negative ones, a loss, sums above 1, and starts that are spread over several bands.
    """
    total = energies.sum(-1)

    def at(values: Tensor, *axes: str) -> str:
        """Where the largest of the values is."""
        place = torch.unravel_index(values.argmax(), values.shape)
        return ", ".join(f"{axis} {int(i) + 1}" for axis, i in zip(axes, place, strict=False))

    runs = ("realization", "source", "time")
    first, most = total[..., 0], total.amax(-1)
    for wrong, value in ((first < 0.5, first), (most > 1.5, most)):
        if bool(wrong.any()):
            place = at(wrong.double(), *runs)
            rule = "be shares of the energy of each run, 1 in all (divide by their sum at the first time)"
            raise checks.fail("energies", rule, f"{float(value[wrong][0]):.3g} in all at {place}")
    own = energies[:, :, 0].mean(0).diagonal() / first.mean(0) if float(times[0]) == 0 else torch.ones(1)
    if float(own.min()) < PURE:
        words = f"{float(own.min()):.3g} of the energy of source {int(own.argmin()) + 1} in its own band at time 0"
        if float(own.min()) < ABSENT:
            raise checks.fail("energies", "start in the band of their source (other starts go into starts=)", words)
        warn("energies", f"{words}: starts=energies[:, :, 0] counts what is in the others")
    if float(energies.min()) < -NOISE:
        warn("energies", f"negative, {float(energies.min()):.3g} at {at(-energies, *runs)}")
    if float(most.max()) > 1 + NOISE:
        warn("energies", f"{float(most.max()):.3g} in all at {at(total, *runs)}: scaled to 1")
    left = total.mean(0) / first.mean(0)[:, None]
    if float(left.min()) < 1 - LOSS:
        words = f"down to {float(left.min()):.3g} of those at the first time, at {at(-left, *runs[1:])}"
        warn(
            "energies",
            f"{words}: the model will lose that much, and what is left late stays (long_time= says what does)",
        )
    return energies / total.clamp(min=1)[..., None]


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of an ensemble.

    Attributes:
        times: (time,), from 0.
        energies: share of each band, (run, time, band).
        realization: number of the chain of every run, (run,), in the order in which they came.
        long_time: exact infinite-time average (run, band); None where some chain has none, or it was not asked for.
        masses: of every chain, (realization, particle).
    """

    times: Tensor
    energies: Tensor
    realization: Tensor
    long_time: Tensor | None
    masses: Tensor

    @property
    def starts(self) -> Tensor:
        """Share of each band in the first frame, (run, band); of runs that all start in one band each, zeros and ones."""
        first = self.energies[:, 0]
        if bool((first.amax(-1) >= PURE).all()):
            return torch.eye(first.shape[-1], dtype=first.dtype)[first.argmax(-1)]
        return first

    def table(self) -> Tensor | None:
        """Which run it is, (realization, source), where each chain has one run that starts in each band; else None."""
        starts, n = self.starts, self.energies.shape[-1]
        cell = self.realization * n + starts.argmax(-1)
        whole = torch.arange(n * len(self.masses))
        if not bool((starts.amax(-1) == 1).all()) or not torch.equal(cell.sort().values, whole):
            return None
        return cell.argsort().reshape(-1, n)


def gathered(
    chains: Chain | Network | Iterable[Chain | Network],
    trajectories: Trajectory | Iterable[Trajectory],
    n_bands: int,
    exact: bool,
    names: Sequence[str] | None = None,
    largest: float | None = None,
) -> Runs:
    """Band energies of runs, one after the other: trajectories that are read when they are asked for stay in memory singly.

    Args:
        chains, trajectories: one of each (chains, or networks), or as many of one as of the other; those with batch axes hold several runs.
        n_bands: B.
        names: of the runs, for messages; by default run 1, run 2, ...
        largest: of networks, the longest wavevector; by default that of the first, for all.
        exact: also take the infinite-time average from the modes, where all chains are linear undamped rings.

    Raises:
        FieldError: naming the run, for times or a number of particles that differ from those of the first.

    Warns:
        FramesWarning: naming the run, for energy that drifts on a chain without damping.
    """
    chains = [chains] if isinstance(chains, (Chain, Network)) else chains
    trajectories = [trajectories] if isinstance(trajectories, Trajectory) else trajectories
    for name, value in (("chains", chains), ("trajectories", trajectories)):
        if not checks.is_collection(value):
            raise checks.FieldTypeError(f"{name} must be one for each run, got {checks.shown(value)}")
    numbers: dict[bytes, list[int]] = {}
    kinds: list[tuple[Tensor, Tensor]] = []
    times = torch.zeros(0, dtype=torch.float64)
    shells: PackingBands | None = None
    energies: list[Tensor] = []
    belongs: list[int] = []
    firsts: list[tuple[Tensor, Tensor]] = []
    trajectory_of = iter(trajectories)
    run = 0
    for run, chain in enumerate(chains, 1):
        name = f"run {run}" if names is None else names[run - 1]
        checks.instance(f"chains, {name}", chain, Chain, Network)
        path = next(trajectory_of, None)
        if path is None:
            raise checks.fail("trajectories", "be as many as chains", f"{run - 1} of them")
        checks.instance(f"trajectories, {name}", path, Trajectory)
        try:
            shells = _shells(chain, shells, n_bands, largest)
            energy = _energy(chain, path, n_bands, shells)
        except checks.FieldError as error:
            raise checks.FieldError(f"{name}: {error}") from None
        check_energy(name, chain, path)
        _check_whole(name, chain.n_particles, energy)
        own = (path.times - path.times[0]).detach().cpu().double()
        if not energies:
            times = own
        _check_same(name, own, times, chain.n_particles, kinds)
        start = path.displacement.select(-1 - len(path.axes_of_a_state), 0).detach()
        if isinstance(chain, Chain) and chain.is_free and chain.contact == "linear" and not chain.is_damped:
            firsts.append((_rows(start), _rows(path.velocity[..., 0, :])))
        else:
            exact = False
        for masses, stiffness in _of_runs(chain, start):
            alike = numbers.setdefault(masses.numpy().tobytes(), [])
            number = next((i for i in alike if _agree(kinds[i][1], stiffness)), len(kinds))
            if number == len(kinds):
                alike.append(number)
                kinds.append((masses, stiffness))
            belongs.append(number)
        energies.append(energy.detach().cpu().double().reshape(-1, *energy.shape[-2:]))
    if not run:
        raise checks.fail("chains", "be at least one", "none")
    if next(trajectory_of, None) is not None:
        raise checks.fail("trajectories", "be as many as chains", f"more than {run}")
    realization, together = torch.tensor(belongs), torch.cat(energies)
    late = None
    if exact:
        displacement, velocity = (torch.cat(part) for part in zip(*firsts, strict=True))
        late = torch.empty(len(together), together.shape[-1], dtype=torch.float64)
        for number, (masses, stiffness) in enumerate(kinds):
            mine = realization == number
            ring = Chain(masses, "periodic", stiffness)
            late[mine] = long_time_band_energy(ring, State(displacement[mine], velocity[mine]), n_bands)
    return Runs(times, together, realization, late, torch.stack([masses for masses, _ in kinds]))


def _shells(
    chain: Chain | Network, shells: PackingBands | None, n_bands: int, largest: float | None
) -> PackingBands | None:
    """The bands of a network: those of the first, as many as are asked for."""
    if not isinstance(chain, Network) or shells is not None:
        return shells
    kinds = 2 if chain.n_components > 1 else 1
    if n_bands < 1 + kinds or (n_bands - 1) % kinds:
        rule = f"be {kinds} times the shells of |q| and 1, for what is in none of them"
        raise checks.fail("n_bands", rule, n_bands)
    return packing_bands(chain, (n_bands - 1) // kinds, largest)


def _energy(chain: Chain | Network, path: Trajectory, n_bands: int, shells: PackingBands | None) -> Tensor:
    """Share of every band, (*any, time, band)."""
    if isinstance(chain, Network):
        if chain.batch_shape:
            raise checks.fail("network", "be one for each run", f"a batch {tuple(chain.batch_shape)}")
        assert shells is not None
        return packing_band_energy(chain, path, shells)
    if isinstance(path, NetworkTrajectory):
        raise checks.fail("chains", "be a network for motion in several directions", "a chain")
    check_bands(chain.n_particles, n_bands)
    return band_energy(chain, path, n_bands)


def _check_whole(name: str, n_particles: int, energy: Tensor) -> None:
    """An error, or a warning, for runs that move as a whole: that energy is in no band."""
    outside = 1 - float(energy.detach().sum(-1)[..., 0].min())
    if outside > max(OUTSIDE, 4 / n_particles):
        words = f"{outside:.3g} of the energy is that of the motion as a whole, in no band (take the mean velocity off)"
        if outside > 0.5:
            raise checks.fail(f"{name}, frame 1: velocities", "be those of a wave", words)
        warn(f"{name}, frame 1: velocities", words)


def _check_same(name: str, own: Tensor, times: Tensor, n_particles: int, kinds: list[tuple[Tensor, Tensor]]) -> None:
    """An error unless a run has the times and the number of particles of the first."""
    # Times that a time step times a step number gives agree to rounding only.
    if own.shape != times.shape or not torch.allclose(own, times, rtol=1e-9, atol=1e-9 * float(times[-1])):
        raise checks.fail(
            f"{name}: times",
            f"be those of the first run ({len(times)} to {float(times[-1]):g})",
            f"{len(own)} to {float(own[-1]):g}",
        )
    if kinds and len(kinds[0][0]) != n_particles:
        raise checks.fail(f"{name}: particles", f"be {len(kinds[0][0])} as in the first run", n_particles)


def _agree(a: Tensor, b: Tensor) -> bool:
    """Whether two runs are of one chain: contact lists of moving particles tell the same stiffness only nearly."""
    return a.shape == b.shape and torch.allclose(a, b, rtol=SAME, atol=SAME * float(a.abs().mean()))


def _rows(values: Tensor) -> Tensor:
    return values.detach().cpu().double().reshape(-1, values.shape[-1])


def _of_runs(chain: Chain | Network, start: Tensor) -> Iterable[tuple[Tensor, Tensor]]:
    """Masses of every run, and what else tells its chain or network from others: contact stiffness, positions."""
    if isinstance(chain, Network):
        rest = torch.cat([chain.bond_stiffness.flatten(), chain.positions.flatten()]).detach().cpu().double()
        return [(chain.masses.detach().cpu().double(), rest)] * start.shape[:-2].numel()
    masses = _rows(chain.align(chain.masses, start).expand(start.shape))
    stiffness = chain.align(chain.contact_stiffness, start)
    stiffness = _rows(stiffness.expand(*start.shape[:-1], stiffness.shape[-1]))
    return zip(masses, stiffness, strict=True)
