"""A family of models on fresh chains of disorders that none of its members has, in windows of time, beside other ensembles."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import torch

import torchchain as tc

MEMBERS = (0.05, 0.1, 0.2, 0.3, 0.5)
UNSEEN = (0.02, 0.035, 0.07, 0.14, 0.4)
WINDOWS = ((0.0, 1.0), (1.0, 5.0), (5.0, 50.0), (50.0, 400.0))
TIMES = torch.cat([torch.arange(0, 5, 0.2), torch.arange(5.0, 50), torch.arange(50.0, 401, 5)]).double()


def ensemble(strength: float, realizations: int, seed: int) -> tc.BandTransfer:
    """Chains of 256 beads in 32 bands."""
    scene = tc.Scene(
        n_particles=256, n_bands=32, realizations=realizations, seed=seed, times=TIMES, disorder=tc.Disorder(strength=strength)
    )  # fmt: skip
    return tc.band_transfer(scene, starts=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each disorder: distances over those of an ensemble as large as the members', shares within one error.

    The first share is of other bands than the source's, the second of its own.
    """
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--smoke", action="store_true", help="few chains")
    flags.add_argument("--seed", type=int, default=0, help="of the members; the other ensembles' follow from it")
    given, _ = flags.parse_known_args(arguments)
    chains, fresh = (16, 16) if given.smoke else (100, 400)
    own = [ensemble(strength, chains, given.seed) for strength in MEMBERS]
    begin = time.process_time()
    family = tc.calibrate_family(own)
    print(f"{family.n_parameters} fitted numbers, {time.process_time() - begin:.1f} s of processor time", flush=True)
    off_diagonal = ~torch.eye(32, dtype=torch.bool)[:, None]
    for strength in UNSEEN:
        reference, other = ensemble(strength, fresh, given.seed + 7), ensemble(strength, chains, given.seed + 3)
        begin = time.process_time()
        master = family.at(strength)
        seconds = time.process_time() - begin
        found = master.transfer(TIMES)
        error = master.standard_error(torch.eye(32, dtype=torch.float64), TIMES).square() + reference.stderr.square()
        inside = ((found - reference.mean).square() < error).double()
        words, times = [], reference.times
        for low, high in WINDOWS:
            here = (times > low) & (times <= high)
            off, noise = (tc.total_variation(x, reference.mean)[:, here].mean() for x in (found, other.mean))
            share = inside[:, here][off_diagonal.expand(-1, int(here.sum()), -1)].mean()
            own_share = inside[:, here].diagonal(dim1=0, dim2=2).mean()
            words.append(f"t <= {high:g}: {float(off / noise):.2f}, {100 * float(share):.0f}, {100 * float(own_share):.0f} %")
        print(f"disorder {strength:g} ({seconds:.1f} s): {'; '.join(words)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
