"""What a run left in its folder, or an older run's file, back in the library's own records."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_file import read_toml
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master import MasterEquation, MasterFamily
from torchchain.master.file import MODEL

if TYPE_CHECKING:
    import xarray

DATA = ("results.nc", "transfer.nc", "sweep.nc")


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run; everything in it is read when it is asked for.

    Attributes:
        path: of the folder.
        record: run.json: command, seed, versions, device, seconds, hashes of the files.
        config: config.toml, the resolved settings.
        scene: of the ensemble; None where the config holds none (a family, a prediction, imported data, a sweep).
        data: results.nc, transfer.nc or sweep.nc, with labeled axes and units.
        transfer: the band transfer that calibrate measured, or was given.
        master: the calibrated master equation; of a prediction's folder the one it was solved with.
        family: the models that ``torchchain family`` joined.
        prediction: band energies by the master equation (source | start, time, receiver | band).

    Raises:
        FieldError: naming the folder and what it does not hold, or holds in a changed form.

    Example:
        >>> import contextlib, io, tempfile
        >>> from torchchain.cli import main
        >>> out = tempfile.mkdtemp()
        >>> words = ["simulate", "--n-particles", "16", "--n-bands", "2", "--realizations", "2", "--times.stop", "1", "--out", out]
        >>> with contextlib.redirect_stdout(io.StringIO()):
        ...     status = main(words)  # as the command torchchain does
        >>> run = tc.open(out)
        >>> run.scene.n_particles, list(run.data.band_energy.dims)
        (16, ['tone', 'time', 'band'])
    """

    path: Path

    @cached_property
    def record(self) -> dict[str, Any]:
        try:
            record = json.loads(self._file("run.json").read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise checks.fail(f"{self.path / 'run.json'}", "be JSON", str(error)) from None
        if not isinstance(record, dict):
            raise checks.fail(f"{self.path / 'run.json'}", "hold a record", checks.shown(record))
        return record

    @cached_property
    def config(self) -> dict[str, Any]:
        return read_toml(self._file("config.toml"))

    @cached_property
    def scene(self) -> Scene | None:
        if (self.path / "transfer.nc").is_file():
            return self.transfer.scene
        fields = {name: value for name, value in self.config.items() if name != "plugins"}
        return Scene.from_dict(fields) if "n_particles" in fields and "sweep" not in fields else None

    @cached_property
    def data(self) -> xarray.Dataset:
        for name in DATA:
            if (self.path / name).is_file():
                return read_dataset(self.path / name)
        raise checks.fail(f"folder {self.path}", f"hold {' or '.join(DATA)}", "none of them")

    @cached_property
    def transfer(self) -> BandTransfer:
        return read_transfer(self.path)[1]

    @cached_property
    def master(self) -> MasterEquation:
        if not (self.path / MODEL).is_file() and isinstance(self.record.get("model"), dict):
            return MasterEquation.load(self.record["model"].get("path", ""))
        return MasterEquation.load(self._file(MODEL))

    @cached_property
    def family(self) -> MasterFamily:
        return MasterFamily.load(self._file(MODEL))

    @cached_property
    def prediction(self) -> xarray.DataArray:
        if "start" in self.data.dims:
            return self.data["band_energy"]
        start = torch.eye(self.master.n_bands, dtype=torch.float64)
        energy = self.master.solve(start, self.transfer.times).detach()
        predicted = self.data["band_energy"].copy(data=energy.numpy()).rename("prediction")
        return predicted.assign_attrs(long_name="share of the energy predicted by the master equation")

    def __repr__(self) -> str:
        files = ", ".join(sorted(path.name for path in self.path.iterdir() if not path.name.startswith(".")))
        command = self.record.get("command", "?") if (self.path / "run.json").is_file() else "no record"
        return f"RunFolder({str(self.path)!r}): {command}\n  holds {files}"

    def _file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise checks.fail(f"folder {self.path}", f"hold {name}", "no such file")
        return path


def open_folder(folder: str | Path) -> RunFolder:
    """The folder that a command left, as its scene, data, transfer, model and prediction.

    Raises:
        FieldError: if it is not a folder, or holds nothing that a run leaves.

    >>> import torchchain as tc
    >>> run = tc.open("results/calibrate")  # doctest: +SKIP
    >>> run.scene.disorder, run.master.n_bands, run.transfer.mean.shape  # doctest: +SKIP
    """
    checks.instance("folder", folder, str, Path)
    path = Path(folder)
    if not path.is_dir():
        raise checks.fail("folder", "be the folder of a run", "a file" if path.exists() else f"nothing at {folder}")
    if not any((path / name).is_file() for name in ("run.json", "config.toml", MODEL, *DATA)):
        raise checks.fail(f"folder {folder}", f"hold what a run leaves: run.json, {MODEL}, {', '.join(DATA)}", "none")
    return RunFolder(path)


def model_file(path: str | Path) -> Path:
    """The model file that is meant: the file itself, or the one in a run's folder."""
    path = Path(path)
    if path.is_dir() and (path / MODEL).is_file():
        return path / MODEL
    return path


def read_transfer(path: str | Path) -> tuple[Path, BandTransfer]:
    """A band transfer from its file, or the ``transfer.nc`` in a folder, and where it was found.

    Raises:
        FieldError: for a file that cannot be read or is not of a band transfer.
    """
    path = Path(path)
    if path.is_dir():
        path /= "transfer.nc"
    return path, BandTransfer.from_dataset(read_dataset(path))


def read_dataset(path: Path) -> xarray.Dataset:
    """A netCDF file, in memory and closed."""
    import xarray

    if not path.is_file():
        raise checks.fail(f"file {path}", "be a readable data file", "no such file")
    try:
        with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as file:
            return file.load()
    except Exception as error:  # whatever the libraries say of a broken file
        raise checks.fail(f"file {path}", "be a readable data file", checks.shown(str(error))) from None
