"""Energy that goes between bands of frequency three at a time: the quadratic term of the master equation (Section 5)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchchain import checks
from torchchain.mixing.bands import FrequencyBands
from torchchain.odes import INTEGRATORS, IntegrationError, member_norm

MOST_STEPS = 10**5  # from one output time to the next


class TriadModel(nn.Module):
    """Rates of change of the energy in bands of frequency by three-wave processes, w_a + w_b = w_c.

    With e the energy per particle in a band, d its modes per particle, and n = e / (d w) its action per mode,

        J = G [n_a n_b - n_c (n_a + n_b)],   de_a/dt = -w_a J,   de_b/dt = -w_b J,   de_c/dt = +w_c J,   G >= 0,

    summed over all triads. Pairs of modes of bands a and b have sums of frequencies that lie in two bands, c = a + b and
    a + b + 1 (bands counted from 0), each from one triangle of the square of pairs. Each triangle is a triad of its own,
    with the mean frequencies of its pairs: (a + 1/3, b + 1/3) widths below the diagonal and (a + 2/3, b + 2/3) above, so
    that w_a + w_b = w_c exactly. From this follow, for every G >= 0:

    - the energy is conserved, exactly: each triad does;
    - energies stay non-negative: where e_a = 0, J = -G n_b n_c <= 0, and where e_c = 0, J = G n_a n_b >= 0;
    - equal energy per mode is a fixed point: 1 / n_c = 1 / n_a + 1 / n_b there;
    - H-theorem: the sum of d log(e / d) never falls: each triad adds G n_a n_b n_c (1 / n_c - 1 / n_a - 1 / n_b)^2.

    The form is that of kinetic equations of three-wave interaction (V. E. Zakharov, V. S. L'vov, G. Falkovich, Kolmogorov
    Spectra of Turbulence I, Springer 1992).

    Args:
        bands: of frequency.
        density: modes per particle in each band, (band,), positive.
        coupling: G of each triad, (triad,), not negative; per unit time and action.

    Attributes:
        triads: the bands (a, b, c) of each triad, counted from 0, (triad, 3).
        frequencies: w_a, w_b, w_c of each, (triad, 3), in radians per travel time of sound over one particle.

    Example:
        >>> bands = tc.mixing.FrequencyBands(n_bands=4, top=2.0)
        >>> n = len(tc.mixing.triads_of(bands)[0])
        >>> model = tc.mixing.TriadModel(bands, torch.full((4,), 0.25), torch.full((n,), 0.02))
        >>> energy = model.solve([0.01, 0.03, 0.0, 0.0], [0.0, 100.0, 4e3])
        >>> energy[-1].round(decimals=4).tolist()  # equipartition
        [0.01, 0.01, 0.01, 0.01]
    """

    triads: Tensor
    frequencies: Tensor
    density: Tensor
    exchange: Tensor

    def __init__(self, bands: FrequencyBands, density: Tensor, coupling: Tensor) -> None:
        super().__init__()
        checks.instance("bands", bands, FrequencyBands)
        triads, frequencies = triads_of(bands)
        density = checks.shaped("density", density, (bands.n_bands,)).to(torch.float64)
        coupling = checks.shaped("coupling", coupling, (len(triads),)).to(torch.float64)
        checks.first_bad("density", "be positive", density, density <= 0, "band")
        checks.first_bad("coupling", "not be negative", coupling, coupling < 0, "triad")
        self.bands = bands
        self.coupling = nn.Parameter(coupling)
        self.register_buffer("density", density)
        self.register_buffer("triads", triads)
        self.register_buffer("frequencies", frequencies)
        signs = frequencies * torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
        exchange = torch.zeros(len(triads), bands.n_bands, dtype=torch.float64)
        self.register_buffer("exchange", exchange.scatter_add(1, triads, signs))

    @property
    def n_parameters(self) -> int:
        """Fitted numbers."""
        return len(self.coupling)

    def flux(self, energy: Tensor) -> Tensor:
        """J / G of every triad, (*batch, triad), from energies per particle (*batch, band)."""
        action = (energy / self.density)[..., self.triads] / self.frequencies
        a, b, c = action.unbind(-1)
        return a * b - c * (a + b)

    def slope(self, energy: Tensor) -> Tensor:
        """de/dt, (*batch, band), from energies per particle (*batch, band)."""
        return (self.coupling * self.flux(energy)) @ self.exchange

    def solve(
        self, initial: Any, times: Any, method: str = "dopri5", rtol: float = 1e-7, atol: float | None = None
    ) -> Tensor:
        """Energies per particle at the given times, by torchdiffeq.

        Args:
            initial: energy per particle in each band at time 0, (*batch, band), not negative, in units of stiffness times
                overlap squared: the speed of all that happens is proportional to it.
            times: (time,), increasing, not negative.
            method: an adaptive method of torchdiffeq.
            rtol, atol: tolerances; atol None: rtol / 1000 of the largest total.

        Returns:
            (*batch, time, band); the sum over bands is that of the start, and none is negative.

        Raises:
            FieldError, FieldTypeError: for a bad argument.
            IntegrationError: if the solver fails, with its numbers.
        """
        import torchdiffeq  # takes a second or two, which most users never need

        adaptive = [name for name, entry in INTEGRATORS.items() if entry.adaptive and name != "scipy_solver"]
        checks.choice("method", method, adaptive)
        initial = checks.real_tensor("initial", initial).to(self.density)
        if initial.ndim == 0 or initial.shape[-1] != self.bands.n_bands:
            raise checks.fail("initial", f"have {self.bands.n_bands} bands on its last axis", initial)
        checks.first_bad("initial", "not be negative", initial, initial < 0, "band")
        times = checks.times("times", times).to(self.density)
        rtol = checks.number("rtol", rtol, above=0, below=1)
        total = initial.sum(-1, keepdim=True)
        scale = float(total.detach().amax()) if total.numel() else 0.0
        if scale == 0:
            return initial[..., None, :].expand(*initial.shape[:-1], len(times), -1)
        atol = rtol / 1000 * scale if atol is None else checks.number("atol", atol, above=0)
        span = times if float(times[0]) == 0 else torch.cat([times.new_zeros(1), times])
        options = {"norm": member_norm, "max_num_steps": MOST_STEPS}
        try:
            path = (
                torchdiffeq.odeint(lambda t, e: self.slope(e), initial, span, rtol=rtol, atol=atol, method=method, options=options)
                if len(span) > 1
                else initial[None]
            )  # fmt: skip
        except AssertionError as error:
            raise IntegrationError(
                f"solver '{method}' must reach time {float(times[-1]):g} with rtol {rtol:g} and atol {atol:g}, got: {error}"
            ) from None
        # The exact solution is not negative; what the solver's error leaves below zero is taken from the other bands.
        path = torch.movedim(path[-len(times) :], 0, -2).clamp(min=0)
        return path * (total[..., None] / path.sum(-1, keepdim=True).clamp(min=torch.finfo(path.dtype).tiny))


def triads_of(bands: FrequencyBands) -> tuple[Tensor, Tensor]:
    """Bands (a, b, c) and frequencies (w_a, w_b, w_c) of every triad with c within the bands, each (triad, 3).

    Example:
        >>> triads, frequencies = tc.mixing.triads_of(tc.mixing.FrequencyBands(n_bands=2, top=2.0))
        >>> triads.tolist()
        [[0, 0, 1], [0, 1, 1]]
    """
    found, places = [], []
    for a in range(bands.n_bands):
        for b in range(a, bands.n_bands - a):
            for above, inside in ((0, 1 / 3), (1, 2 / 3)):
                if 0 < a + b + above < bands.n_bands:  # three waves of one band exchange nothing
                    found.append((a, b, a + b + above))
                    places.append((a + inside, b + inside, a + b + 2 * inside))
    return torch.tensor(found), torch.tensor(places, dtype=torch.float64) * bands.width
