"""Band energies from the theory of disorder, without chains (docs/theory.md)."""

from torchchain.theory.derivative import transfer_at
from torchchain.theory.fit import DisorderFit, fit_disorder
from torchchain.theory.lattices import lattice_transfer
from torchchain.theory.law import Law, law_of
from torchchain.theory.localized import MEASURED, Return
from torchchain.theory.medium import EffectiveMedium, born_rates, effective_medium
from torchchain.theory.transfer import TheoryTransfer, theory_transfer

__all__ = [
    "MEASURED",
    "DisorderFit",
    "EffectiveMedium",
    "Law",
    "Return",
    "TheoryTransfer",
    "born_rates",
    "effective_medium",
    "fit_disorder",
    "lattice_transfer",
    "law_of",
    "theory_transfer",
    "transfer_at",
]
