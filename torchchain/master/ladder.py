"""The reduced models by name, from the paper's (Q, Psi) upward, and how one of your own joins them.

=============  ==============================================================  =======================================
model          what it adds                                                    fitted numbers, B bands
=============  ==============================================================  =======================================
paper          rates Q, basis energy Psi of Eq. 47                             B^2 (1 with Eq. 50 for Q)
exact_psi      Psi from the exact long-time average of the modes               B^2 + B
basis_matrix   basis energy of every pair of bands, Pi[s, r]                   2 B^2
swing_in       rates that act some time after the energy came                  2 B^2 + 1
theory         the theory of disorder, without chains                          none
corrected_...  the theory times exponentials of polynomials; never negative    9 to 80, whatever B
ringing_...    beats of clusters on top of these, for binary masses            486 or 750, whatever B
memory         any response, as a few decay rates shared by all pairs          B^2 (1 + functions - 1) + their rates
compact        odds of damped beats, corrected by polynomials; never negative  53 to 806, whatever B
=============  ==============================================================  =======================================
"""

from __future__ import annotations

from torchchain import checks
from torchchain.master.compact_record import COMPACT
from torchchain.master.derived import CORRECTED, RINGING, THEORY
from torchchain.master.memory import MEMORY
from torchchain.master.model import TransferModel
from torchchain.master.rates import BASIS_MATRIX, EXACT_PSI, PAPER, SWING_IN
from torchchain.master.records import Fit, ReducedModel

MODELS: dict[str, ReducedModel] = {
    record.name: record for record in (PAPER, EXACT_PSI, BASIS_MATRIX, SWING_IN, MEMORY, THEORY, CORRECTED, RINGING, COMPACT)
}  # fmt: skip


def register_model(record: ReducedModel) -> ReducedModel:
    """Make a reduced model known to ``calibrate``, selection and files, under its own name and kind.

    Args:
        record: see :class:`ReducedModel`.

    Returns:
        The record.

    Raises:
        FieldError: for a name, a kind or a fit's name that another has.

    Example:
        >>> import torch, torchchain as tc
        >>> def still(sample, recipe, near, progress):  # all energy stays where it is
        ...     n = sample.n_bands
        ...     return tc.RateModel(torch.zeros(n, n), torch.ones(n)), None
        >>> _ = tc.register_model(tc.master.ReducedModel(
        ...     "still", "nothing moves", tc.RateModel, (tc.master.Fit("rest", "no fit", still),), lambda n, damped, s: 0))
    """
    checks.instance("record", record, ReducedModel)
    if record.name in MODELS:
        raise checks.fail("name", f"differ from {', '.join(MODELS)}", record.name)
    known = kinds().get(record.kind.kind, record.kind)
    if known is not record.kind:
        raise checks.fail("kind", "be free", record.kind.kind)
    fits = methods()
    for fit in record.fits:
        if fits.get(fit.name, fit) != fit:
            raise checks.fail("fits", "have names that no other fit has", fit.name)
    MODELS[record.name] = record
    return record


def kinds() -> dict[str, type[TransferModel]]:
    """The classes of the models, by the kind that their files name."""
    return {record.kind.kind: record.kind for record in MODELS.values()}


def methods() -> dict[str, Fit]:
    """Every way to fit, by name."""
    return {fit.name: fit for record in MODELS.values() for fit in record.fits}


def fitted_by(method: str) -> list[ReducedModel]:
    """The models that a method fits."""
    return [record for record in MODELS.values() if any(fit.name == method for fit in record.fits)]
