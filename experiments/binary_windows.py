"""What a calibration chooses for binary masses, and how near it is to fresh chains in windows of time, beside another ensemble."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import torch
from error_bars import WINDOWS

import torchchain as tc

TIMES = torch.cat([torch.arange(0, 5, 0.2), torch.arange(5.0, 50), torch.arange(50.0, 401, 5)]).double()
STRENGTHS = (0.3, 0.5, 0.6, 0.7, 0.9)


def ensemble(strength: float, realizations: int, seed: int, kind: str) -> tc.BandTransfer:
    """Chains of 256 beads in 32 bands."""
    scene = tc.Scene(
        n_particles=256, n_bands=32, realizations=realizations, seed=seed, times=TIMES, disorder=tc.Disorder(kind, strength)
    )  # fmt: skip
    return tc.band_transfer(scene, starts=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each strength: the model, its fitted numbers, distances over those of an ensemble as large."""
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--smoke", action="store_true", help="few chains, one strength")
    flags.add_argument("--seed", type=int, default=30, help="of the calibrated chains; the other ensembles' follow from it")
    flags.add_argument("--kind", default="binary", help="of the masses")
    flags.add_argument("--model", help="instead of the one that is chosen")
    flags.add_argument("--strengths", type=float, nargs="+", default=STRENGTHS)
    given, _ = flags.parse_known_args(arguments)
    chains, fresh = (16, 16) if given.smoke else (100, 400)
    for strength in (0.5,) if given.smoke else given.strengths:
        calibrated, other, reference = (
            ensemble(strength, n, given.seed + i, given.kind) for i, n in ((0, chains), (3, chains), (7, fresh))
        )
        begin = time.process_time()
        master = tc.calibrate(calibrated, model=given.model)
        seconds = time.process_time() - begin
        found, words = master.transfer(TIMES), []
        for low, high in WINDOWS:
            here = (low < TIMES) & (high >= TIMES)
            off, noise = (tc.total_variation(x, reference.mean)[:, here].mean() for x in (found, other.mean))
            words.append(f"{float(off / noise):.2f}")
        print(
            f"{given.kind} {strength:g}: {master.calibration.model}, {master.n_parameters} numbers, {seconds:.1f} s; windows up to "
            f"{', '.join(f'{high:g}' for _, high in WINDOWS)}: {', '.join(words)}; lowest energy {float(found.min()):.0e}", flush=True
        )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
