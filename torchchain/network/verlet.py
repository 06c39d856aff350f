"""Velocity Verlet for networks: linear bonds, and grains whose contacts open, close and turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.evolvers.method import Advance, Method, targets_of
from torchchain.evolvers.symplectic import check_limits, substeps
from torchchain.network.bonds import moved
from torchchain.network.modes import check_stability
from torchchain.network.networks import Network
from torchchain.network.packings import Packing, contact_law, near_pairs
from torchchain.network.trajectories import NetworkTrajectory

DEFAULT = 0.1  # step, in units of 1 / W
SKIN = 0.2  # of the largest radius: pairs are listed up to gaps of that


def start(network: Network, state: State, step: float | None = None, linear: bool | None = None) -> Advance:
    """See the registry entry below.

    Raises:
        FieldError: for a step at or beyond the stability limit, 2 / W.
        UnstableError: for linear motion of a network that is not stable.
    """
    grains = isinstance(network, Packing) and not (linear is not None and checks.truth("linear", linear))
    if linear is False and not grains:
        raise checks.fail("linear", "be True or None for a network that is no packing", linear)
    with torch.no_grad():
        top, rate = network.squared_frequency_bound().sqrt(), _damping_rate(network)
    if step is None:
        step = DEFAULT / max(top.amax().item(), rate.amax().item(), 1e-300)
    step = checks.number("step", step, above=0)
    check_limits(step, "verlet", [("W", 2.0, top), ("d_max", 2.0, rate)])
    if grains:
        assert isinstance(network, Packing)
        return _grains(network, state, step)
    check_stability(network)  # linear motion would grow without limit
    return _linear(network, state, step)


def _damping_rate(network: Network) -> Tensor:
    """A bound on the eigenvalues of M^-1 D, (*batch,)."""
    ends, (i, j) = network.bond_damping, network.bonds.unbind(-1)
    total = ends.new_zeros(*network.batch_shape, network.n_particles + network.n_anchors)
    total = total.index_add(-1, i, ends).index_add(-1, j, ends)
    return (2 * total[..., : network.n_particles] / network.masses).amax(-1)


def _steps(times: Tensor, now: float, step: float) -> Iterator[tuple[float, int, float]]:
    """Each time with the number and the length of the steps that lead to it, from ``now`` on."""
    targets = targets_of(times, now)
    for t, before, count in zip(targets, [now, *targets], substeps(now, targets, step).tolist(), strict=False):
        yield t, count, (t - before) / max(count, 1)


def _linear(network: Network, state: State, step: float) -> Advance:
    """Forces -K u - D v in plain torch; the dashpots act by the explicit midpoint rule around each step's end."""
    u, v = state.displacement, state.velocity
    inverse = 1 / network.align(network.masses, u)
    force = network.force(u) * inverse
    damped, now = network.is_damped, 0.0

    def drag(v: Tensor, h: float) -> Tensor:
        return v + h * inverse * network.damping_force(v + h / 2 * inverse * network.damping_force(v))

    def advance(times: Tensor) -> NetworkTrajectory:
        nonlocal u, v, force, now
        outputs = []
        for t, count, h in _steps(times, now, step):
            for _ in range(count):
                v = drag(v, h / 2) if damped else v
                v = v + h / 2 * force
                u = u + h * v
                force = network.force(u) * inverse
                v = v + h / 2 * force
                v = drag(v, h / 2) if damped else v
            now = t
            outputs.append(torch.stack([u, v]))
        displacement, velocity = torch.stack(outputs, dim=-3)
        return NetworkTrajectory(times, displacement, velocity)

    return advance


def _grains(network: Packing, state: State, step: float) -> Advance:
    """Forces of the contact law at the grains' places, on the CPU; lists of near pairs are made anew as grains move."""
    from torchchain.network import kernels  # imports Numba

    if state.displacement.device.type != "cpu":
        raise checks.fail(
            "state", "be on the CPU for grains (linear=True: the network's linear motion)", "another device"
        )
    shape, dtype = state.displacement.shape, state.displacement.dtype
    damping = torch.as_tensor(network.damping)
    if damping.numel() and bool((damping != damping.flatten()[0]).any()):
        raise checks.fail("damping", "be one number for grains, whose contacts change", "several")
    gamma = damping.flatten()[0].item() if damping.numel() else 0.0
    radii = network.radii.detach().double().numpy()
    skin = SKIN * float(radii.max())
    home = network.positions.detach().double().numpy()
    places, speeds = (
        x.detach().double().reshape(-1, *shape[-2:]).numpy() for x in (state.displacement, state.velocity)
    )
    rows = [(home + u, v.copy()) for u, v in zip(places, speeds, strict=True)]
    masses = network.masses.detach().double().reshape(-1, network.n_particles).numpy()
    starts = max(len(rows) // len(masses), 1)
    hertz = network.contact == "hertz"
    now = 0.0

    def lists(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs, images = near_pairs(torch.from_numpy(x), network.radii, network.box, skin)
        shifts = images.double() if network.box is None else moved(images, network.box.double())
        return pairs.numpy(), np.ascontiguousarray(shifts.numpy())

    listed = [(x.copy(), *lists(x)) for x, _ in rows]

    forces = [np.empty_like(x) for x, _ in rows]
    for (x, v), (_, pairs, shifts), force in zip(rows, listed, forces, strict=True):
        kernels.grain_force(x, radii, pairs, shifts, hertz, network.modulus, gamma, v, force)

    def advance(times: Tensor) -> NetworkTrajectory:
        nonlocal now
        out = torch.empty((2, len(rows), len(times), *shape[-2:]), dtype=dtype)
        for k, (t, count, h) in enumerate(_steps(times, now, step)):
            for row, (x, v) in enumerate(rows):
                left = count
                while left:
                    origin, pairs, shifts = listed[row]
                    left -= kernels.grain_steps(
                        x, v, masses[row // starts], radii, pairs, shifts, hertz, network.modulus, gamma, h, left, origin,
                        skin / 2 * 0.9, forces[row],
                    )  # fmt: skip
                    if left:
                        listed[row] = (x.copy(), *lists(x))
                out[0, row, k], out[1, row, k] = torch.from_numpy(x - home), torch.from_numpy(v)
            now = t
        displacement, velocity = out.reshape(2, *shape[:-2], len(times), *shape[-2:])
        return NetworkTrajectory(times, displacement, velocity, openings=_openings(network, displacement))

    return advance


def _openings(network: Packing, displacement: Tensor) -> Tensor:
    """Contacts of the network found open at an output, at it or before, (*batch, *any, time)."""
    length = (network.bond_vectors + network.elongation(displacement)).square().sum(-1).sqrt()
    is_open = length >= network.radii[network.bonds].sum(-1)
    return (is_open.cumsum(-2) > 0).sum(-1)


def grain_energy(network: Packing, trajectory: NetworkTrajectory) -> Tensor:
    """Energy of the grains under the contact law itself, kinetic and in overlaps, less that of the overlaps at rest.

    Counts the contacts of the network, closed or open, and none that formed later.

    Returns:
        (*batch, time).

    Example:
        >>> x = torch.tensor([[0.0, 0.0], [0.9, 0.0], [0.0, 0.9], [0.9, 0.9]], dtype=torch.float64)
        >>> grains = tc.packing(x, torch.full((4,), 0.5), torch.ones(4), box=torch.tensor([1.8, 1.8]), contact="hertz")
        >>> kick = tc.State(torch.zeros(4, 2, dtype=torch.float64), torch.zeros(4, 2, dtype=torch.float64))
        >>> kick.velocity[0, 0] = 0.01
        >>> path = tc.evolve(grains, kick, [0.0], method="verlet", step=0.01)
        >>> f"{tc.network.grain_energy(grains, path)[0].item():.1e}"
        '5.0e-05'
    """

    def stored(length: Tensor) -> Tensor:
        overlap = network.radii[network.bonds].sum(-1) - length
        force, _ = contact_law(overlap, network.contact, network.modulus)
        return force * overlap.clamp(min=0) * (0.5 if network.contact == "linear" else 0.4)

    displacement, velocity = trajectory.displacement, trajectory.velocity
    length = (network.bond_vectors + network.elongation(displacement)).square().sum(-1).sqrt()
    return network.kinetic_energy(velocity).sum(-1) + (stored(length) - stored(network.lengths)).sum(-1)


METHOD = Method(
    name="verlet",
    start=start,
    summary="velocity Verlet; grains of a packing move under the contact law itself, contacts opening, closing and turning",
    order="2; the phase error of a mode grows as w^3 step^2 t / 24",
    conserves="a nearby energy exactly, so that the energy of linear networks only swings, by (W step)^2 / 4; momentum",
    stability="W step < 2; grains: W is that of the state at rest, and Hertz contacts stiffen as the root of the overlap",
    cost="one force per step",
    cannot="keep phases: their error grows with time; gradients and accelerators, for grains",
    contacts=("linear", "hertz"),
    damped=True,
    candidate=True,
    order_in_step=2,
    phase_error=1 / 24,
    stability_limit=2.0,
    options={
        "step": "largest step; outputs are reached by equal steps of at most that (default 0.1 / W)",
        "linear": "True for the linear motion of a packing's network",
    },
)
