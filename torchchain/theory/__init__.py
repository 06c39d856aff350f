"""Band energies from the theory of disorder, without chains."""

from torchchain.theory.medium import EffectiveMedium as EffectiveMedium
from torchchain.theory.medium import born_rates as born_rates
from torchchain.theory.medium import effective_medium as effective_medium
from torchchain.theory.transfer import TheoryTransfer as TheoryTransfer
from torchchain.theory.transfer import theory_transfer as theory_transfer
