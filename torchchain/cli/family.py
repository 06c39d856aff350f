"""``torchchain family``."""

from __future__ import annotations

import time

import torch

from torchchain import checks
from torchchain.cli import outputs, plugins
from torchchain.cli.flags import Family
from torchchain.master import MasterEquation, MasterFamily
from torchchain.results import model_file


def run_family(flags: Family, arguments: list[str]) -> None:
    """Join models of several strengths and leave the family and its record."""
    began = time.time()
    plugins.load(())
    if not flags.models:
        raise checks.fail("models", "be at least one file", "none")
    paths = [model_file(path) for path in flags.models]
    outputs.check_apart(flags.out, *paths)
    with outputs.run_folder(flags.out) as out:
        family = MasterFamily([MasterEquation.load(path) for path in paths])
        times = torch.linspace(0, 500, 101, dtype=torch.float64)[1:]
        left_out, strengths = family.leave_one_out(times), family.strengths
        title = f"disorder 0 to {strengths[-1]:g}, calibrated at {', '.join(f'{xi:g}' for xi in strengths)}"
        told = "left out and predicted by the others, 0 < t <= 500"
        outputs.leave(
            out, {"model.safetensors": family.save}, arguments, "", "cpu", began, {}, title=title,
            strengths=list(strengths), left_out=left_out,
            models=[{"path": str(path.resolve()), "sha256": outputs.sha256(path)} for path in paths],
            measured=[(f"total variation at disorder {strength:g}, {told}", off, None) for strength, off in left_out],
        )  # fmt: skip
    print(title)
    for strength, distance in left_out:
        print(f"{told}: {strength:g}, total variation {distance:.4f}")
    print(f"results in {out}")
