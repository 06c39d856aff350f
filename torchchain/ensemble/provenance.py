"""Where a band transfer comes from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace

from torch import Tensor

from torchchain import checks


@dataclass(frozen=True)
class Provenance:
    """Where a band transfer comes from.

    Attributes:
        kind: "simulated" from a scene, or "imported".
        words: for people.
        hashes: SHA-256 by name of what it was made from.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=16, n_bands=2, realizations=2, times=[0.0]), method="modes")
        >>> transfer.provenance.kind
        'simulated'
    """

    kind: str = "imported"
    words: str = ""
    hashes: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks.instance("provenance.kind", self.kind, str)
        checks.instance("provenance.words", self.words, str)
        checks.instance("provenance.hashes", self.hashes, dict)


def of_energies(provenance: str | Provenance, times: Tensor, energies: Tensor) -> Provenance:
    """Where the data come from, with the hash of the numbers."""
    if not isinstance(provenance, Provenance):
        checks.instance("provenance", provenance, str)
        provenance = Provenance("imported", provenance)
    numbers = hashlib.sha256(energies.contiguous().numpy().tobytes() + times.numpy().tobytes())
    return replace(provenance, hashes={**provenance.hashes, "energies": numbers.hexdigest()})
