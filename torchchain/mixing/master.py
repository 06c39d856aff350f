"""The master equation of Hertz chains: linear transfer between bands of wavenumber, and triads between those of frequency."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.energy.bands import check_bands
from torchchain.energy.wavenumber import mean_weight, mode_transforms
from torchchain.ensemble.scene import Scene
from torchchain.master.equation import MasterEquation
from torchchain.mixing.bands import FrequencyBands
from torchchain.mixing.triads import TriadModel
from torchchain.modes.motion import change_basis, modal_amplitudes
from torchchain.modes.spectrum import normal_modes

FORMAT = "torchchain-nonlinear-master-equation"
FORMAT_VERSION = 1
LARGEST_FILE = 2**28  # bytes
_TENSORS = ("linear", "coupling", "density", "spectrum", "shapes")


@dataclass(frozen=True, eq=False)
class NonlinearMasterEquation:
    """Band energies of chains whose contacts are a little nonlinear.

    The linear model T moves energy among bands of wavenumber k while each frequency keeps its own; triads move it among
    bands of frequency f. What a frequency keeps of its start, r_f = min(1, e_f(t) / e_f(0)), goes on as in the linear chain,
    and what it has gained appears over wavenumbers as its modes are made:

        e_k(t) = sum over s of e_s(0) r_s(t) T_sk(t) + sum over f of [e_f(t) - r_f(t) e_f(0)] F_fk,

    e_f(0) = sum over s of e_s(0) P_sf and r_s = sum over f of P_sf r_f. The sum over k is that of the start, and no band is
    negative where T is not.

    Attributes:
        linear: calibrated on the linear chains.
        triads: fitted to the same chains with Hertz contacts.
        spectrum: P, share of the energy of a tone in band s that lies in each band of frequency, (source, frequency).
        shapes: F, share of the energy of the modes of a frequency in each band of wavenumber, (frequency, receiver).

    Example:
        >>> scene = tc.Scene(n_particles=32, n_bands=4, realizations=8, times=torch.linspace(0, 40, 41))
        >>> bands = tc.mixing.FrequencyBands.covering(scene.chain(range(8)), n_bands=4)
        >>> data = tc.mixing.measure_mixing(scene, 0.1, bands, times=torch.linspace(0, 200, 9))
        >>> both = tc.mixing.NonlinearMasterEquation.of(tc.calibrate(tc.band_transfer(scene), model="paper", method="linear"), tc.mixing.fit_triads(data).model)
        >>> energy = both.solve([0.0, 1.0, 0.0, 0.0], [0.0, 20.0, 40.0], energy_per_particle=0.01)
        >>> energy.sum(-1).round(decimals=6).tolist()
        [1.0, 1.0, 1.0]
    """

    linear: MasterEquation
    triads: TriadModel
    spectrum: Tensor
    shapes: Tensor

    def __post_init__(self) -> None:
        checks.instance("linear", self.linear, MasterEquation)
        checks.instance("triads", self.triads, TriadModel)
        wanted = (self.linear.n_bands, self.triads.bands.n_bands)
        for name, shape in (("spectrum", wanted), ("shapes", wanted[::-1])):
            value = checks.shaped(name, getattr(self, name), shape).to(torch.float64)
            off = (value.sum(-1) - 1).abs() > 1e-6
            checks.first_bad(name, "have rows of sum 1", value.sum(-1), off, "row")
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, linear: MasterEquation, triads: TriadModel) -> NonlinearMasterEquation:
        """With P and F from the normal modes of the scene that the linear model was calibrated on.

        Raises:
            FieldError: for a model without a scene, or of lattices.
        """
        return cls(linear, triads, *spectrum_and_shapes(scene_of(linear), triads.bands))

    def solve(self, initial: Any, times: Any, energy_per_particle: float, **options: Any) -> Tensor:
        """Energies in the bands of wavenumber at the given times.

        Args:
            initial: share of the energy in each band of wavenumber at time 0, (*batch, band), of any sum.
            times: (time,), increasing, not negative.
            energy_per_particle: that a sum of 1 stands for, in units of stiffness times overlap squared; it sets the
                speed of the nonlinear part. A standing wave of tone n and amplitude A has A^2 sin^2(pi n / N).
            options: of :meth:`TriadModel.solve`.

        Returns:
            (*batch, time, band), in the unit of ``initial``. The sum stays that of the start.
        """
        energy_per_particle = checks.number("energy_per_particle", energy_per_particle, above=0)
        moved = self.linear.transfer(times)
        start = checks.real_tensor("initial", initial).to(self.spectrum)
        if start.ndim == 0 or start.shape[-1] != self.linear.n_bands:
            raise checks.fail("initial", f"have {self.linear.n_bands} bands on its last axis", start)
        return self.joined(start, moved, times, energy_per_particle, **options)

    def joined(self, start: Tensor, moved: Tensor, times: Any, energy_per_particle: float, **options: Any) -> Tensor:
        """What :meth:`solve` returns, from the linear transfer at the given times, [source, time, receiver]."""
        before = (start @ self.spectrum)[..., None, :]
        later = self.triads.solve(before[..., 0, :] * energy_per_particle, times, **options) / energy_per_particle
        there = before > 0
        kept = torch.where(there, later / torch.where(there, before, 1.0), 1.0).clamp(max=1)
        linear = torch.einsum("...s,...ts,stk->...tk", start, kept @ self.spectrum.T, moved)
        return linear + (later - kept * before) @ self.shapes

    def save(self, path: str | Path) -> None:
        """Write both models to one safetensors file; it appears whole or not at all.

        Raises:
            FieldError: for a path that cannot be written.
        """
        checks.instance("path", path, str, Path)
        path = Path(path)
        bands = self.triads.bands
        header = {"format": FORMAT, "format_version": FORMAT_VERSION, "n_bands": bands.n_bands, "top": bands.top}
        try:
            with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
                part = Path(folder, "linear")
                self.linear.save(part)
                tensors = {
                    "linear": torch.from_numpy(np.fromfile(part, dtype=np.uint8)),  # its own file, with all its checks
                    "coupling": self.triads.coupling.detach(),
                    "density": self.triads.density,
                    "spectrum": self.spectrum,
                    "shapes": self.shapes,
                }
                whole = Path(folder, "whole")
                save_file({k: v.contiguous() for k, v in tensors.items()}, whole, {"torchchain": json.dumps(header)})
                whole.replace(path)
        except OSError as error:
            raise checks.fail(f"file {path}", "be writable", f"{error.strerror or error}") from None

    @classmethod
    def load(cls, path: str | Path) -> NonlinearMasterEquation:
        """Read and check a file of :meth:`save`.

        Raises:
            FieldError: for a file that is none.
        """
        checks.instance("path", path, str, Path)
        where = f"file {path}"
        try:
            if Path(path).stat().st_size > LARGEST_FILE:
                raise checks.fail(where, f"be at most {LARGEST_FILE} bytes", Path(path).stat().st_size)
            with safe_open(path, framework="pt") as file:
                header = json.loads((file.metadata() or {}).get("torchchain", "null"))
                tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise checks.fail(where, f"carry the format {FORMAT}", checks.shown(header))
            if header.get("format_version") != FORMAT_VERSION or sorted(tensors) != sorted(_TENSORS):
                raise checks.fail(where, f"have format version {FORMAT_VERSION} and its tensors", sorted(tensors))
            with tempfile.TemporaryDirectory() as folder:
                part = Path(folder, "linear")
                part.write_bytes(tensors["linear"].to(torch.uint8).numpy().tobytes())
                linear = MasterEquation.load(part)
            bands = FrequencyBands(header["n_bands"], header["top"])
            triads = TriadModel(bands, tensors["density"], tensors["coupling"])
            return cls(linear, triads, tensors["spectrum"], tensors["shapes"])
        except OSError as error:
            raise checks.fail(where, "be a readable file", f"{error.strerror or error}") from None
        except (SafetensorError, checks.FieldError, checks.FieldTypeError, ValueError, TypeError, KeyError) as error:
            raise checks.fail(
                where, "be a nonlinear master equation saved by torchchain", checks.shown(str(error))
            ) from None


def scene_of(linear: MasterEquation) -> Scene:
    """What the model was calibrated on; an error if that was no scene."""
    checks.instance("linear", linear, MasterEquation)
    scene = linear.calibration.scene
    if scene is None:
        raise checks.fail("linear", "be calibrated on a scene, whose modes tell its spectrum", "data without a scene")
    return scene


def spectrum_and_shapes(scene: Scene, bands: FrequencyBands, realizations: int = 32) -> tuple[Tensor, Tensor]:
    """P [source, frequency] and F [frequency, receiver] of :class:`NonlinearMasterEquation`, from normal modes.

    P is the mean over the tones of a band. F is the mean over the modes of a frequency of the energy of each over
    wavenumbers, (w^2 (M s)^ s^* + (-K s)^ s^*) / (2 w^2) = Re (M s)^ s^*, the same for both halves.

    Args:
        scene: rings of linear or Hertz chains, whose linear modes are taken.
        bands: of frequency.
        realizations: chains to average over, at most those of the scene.

    Example:
        >>> scene = tc.Scene(n_particles=32, n_bands=4, disorder=tc.Disorder(strength=0.0), realizations=1)
        >>> spectrum, shapes = tc.mixing.spectrum_and_shapes(scene, tc.mixing.FrequencyBands(4, 2.0))
        >>> spectrum.round(decimals=2).tolist()[0]  # tones 1 to 4 of the ordered ring
        [0.5, 0.5, 0.0, 0.0]
    """
    checks.instance("scene", scene, Scene)
    if scene.lattice is not None:
        raise checks.fail("lattice", "be None: triads are of chains", repr(scene.lattice))
    count, n = min(realizations, scene.realizations), scene.n_particles
    chain = scene.chain(range(count))
    modes = normal_modes(chain)
    members = bands.members(modes.frequencies)
    width = check_bands(n, scene.n_bands)
    wave = StandingWave(tones=tuple(range(1, n // 2 + 1)), phase="cos").state(chain)
    amplitude = modal_amplitudes(chain, wave, modes)[0]
    energy = change_basis((modes.frequencies[:, None] * amplitude).square(), members)
    spectrum = (energy / energy.sum(-1, keepdim=True)).mean(0).unflatten(0, (scene.n_bands, width)).mean(1)
    shapes = (members.mT @ mean_weight(mode_transforms(chain, modes, "site"), scene.n_bands)).sum(0)
    return spectrum / spectrum.sum(-1, keepdim=True), shapes / shapes.sum(-1, keepdim=True)
