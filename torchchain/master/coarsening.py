"""The model of fewer and wider bands."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.ensemble.scene import Scene
from torchchain.master.certificate import certify
from torchchain.master.compact import OddsModel
from torchchain.master.memory import MemoryModel
from torchchain.master.model import TransferModel
from torchchain.master.report import Calibration, Report
from torchchain.master.uncertainty import Uncertainty


def coarsen(
    model: TransferModel, record: Calibration, errors: Uncertainty | None, n_bands: int
) -> tuple[TransferModel, Calibration, Uncertainty | None]:
    """Model, calibration and uncertainty of wider bands: transfers averaged over the sources and summed over the receivers."""
    own = model.as_memory() if isinstance(model, OddsModel) else model
    if not isinstance(own, MemoryModel):
        raise checks.fail("model", "be 'memory' to be coarsened", repr(record.model))
    n_bands = checks.integer("n_bands", n_bands, 1, model.n_bands)
    if model.n_bands % n_bands:
        raise checks.fail("n_bands", f"divide the {model.n_bands} bands of the model", n_bands)
    size = model.n_bands // n_bands
    joined = torch.eye(n_bands).to(model.basis).repeat_interleave(size, dim=0)
    tensors = own.tensors()
    for name in ("rates", "basis", "amplitudes"):
        tensors[name] = joined.T / size @ tensors[name] @ joined
    tensors["damping"] = tensors["damping"] @ joined / size
    wide, report = MemoryModel(**tensors), _report(record.report, joined)
    if record.report.certificate is not None:  # sums of what is not negative; proved again all the same
        proof = certify(wide)
        report = replace(report, certificate=proof if proof.holds else None)
    record = replace(record, scene=_scene(record.scene, n_bands), report=report)
    return wide, record, None if errors is None else errors.coarsened(joined)


def _report(report: Report, joined: Tensor) -> Report:
    loss = report.loss
    if loss is not None:
        rates = torch.tensor(loss.rates).to(joined) @ joined / joined.sum(0)
        loss = replace(loss, rates=tuple(rates.tolist()))
    return Report(loss=loss, horizon=report.horizon, bootstrap=report.bootstrap, coarsened_from=len(joined))


def _scene(scene: Scene | None, n_bands: int) -> Scene | None:
    """The scene with fewer bands and their center tones."""
    if scene is None:
        return None
    assert isinstance(scene.excitation, StandingWave), "transfers come from standing waves"
    return replace(scene, n_bands=n_bands, excitation=replace(scene.excitation, tones=None))
