"""The records of a fit and of a reduced model: all that calibration, selection, file and help want to know of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.fits import WINDOW
from torchchain.master.model import TransferModel
from torchchain.master.sample import Sample

Progress = Callable[[int], Any] | None
"""Called with 1 after every step of a long fit."""
Fitted = tuple[TransferModel, Any]
"""A model, and the record of its fit: an instance of ``Fit.report``, or None."""


@dataclass(frozen=True)
class NoSettings:
    """Of a fit that has none.

    Example:
        >>> tc.master.NoSettings()
        NoSettings()
    """


@dataclass(frozen=True)
class Fit:
    """One way to fit: what ``calibrate(method=)`` names.

    Attributes:
        name: as an identifier.
        summary: one line.
        run: ``run(sample, recipe, near, progress)`` -> :data:`Fitted`; ``near`` is the model of a similar sample to
            start from, or None.
        settings: a frozen dataclass that checks its fields, all of which have defaults: the keywords of ``calibrate``.
        report: a frozen dataclass of what the fit tells, kept in the file.
        window: first and last time of a fit at short times, where none is given.
        least_times: that the window must hold.
        quick: whether error bars are drawn where nobody asks.
        check: ``check(settings, n_times)`` raises where so many times are too few.

    Example:
        >>> [fit.name for fit in tc.MODELS["paper"].fits]
        ['analytic', 'linear', 'nonlinear', 'adam']
    """

    name: str
    summary: str
    run: Callable[..., Fitted]
    settings: type = NoSettings
    report: type | None = None
    window: tuple[float, float] = WINDOW
    least_times: int = 2
    quick: bool = True
    check: Callable[[Any, int], Any] = lambda settings, n_times: None

    @property
    def settings_names(self) -> tuple[str, ...]:
        return tuple(entry.name for entry in dataclasses.fields(self.settings))


@dataclass(frozen=True)
class ReducedModel:
    """A reduced model: what ``calibrate(model=)`` names.

    Attributes:
        name: as an identifier.
        summary: one line.
        kind: its class, which names the tensors of its file and their axes.
        fits: the ways to fit it.
        size: ``size(n_bands, damped, settings)`` -> fitted numbers: its place in the ladder.
        usual: the fit where the model alone is named; none for the first.
        climbed_by: the fit by which selection tries it; None leaves it out of the ladder.
        default: whether it is what a fit that is named alone fits (the last of them whose needs are met).
        basis: what stays for good by it, [source, receiver], where that is not fitted.
        needs_long_time: whether it needs the long-time average.
        needs_strength: whether it needs the strength of the disorder.
        fits_loss: whether it describes the energy lost by damped chains itself; it needs no long-time average then.
        rungs: settings of ``climbed_by`` that selection tries, from the fewest fitted numbers up.
        check_scene: raises a FieldError for chains, or data without a scene (None), that it cannot describe.
        tried_on: whether selection tries it on the chains of a scene that it describes.
        windows: ends of windows of time, in each of which selection holds it to the ensemble's error; none: on average.
        near: distance from fresh chains over that of two ensembles, up to which it will do in each window.
        never_negative: whether its energies are never negative by its form. Of damped chains, whose energies no
            certificate covers, selection tries no other model where such a one describes them.
        slow: whether a prediction takes the better part of a second: of models as good, selection takes one that is not.
        replicas: ``replicas(transfer, recipe, model, repeats)`` -> the models of ensembles in which the blocks are
            repeated, (replica, block), where that is quicker than to fit each from its energies.

    Example:
        >>> model = tc.MODELS["paper"]
        >>> model.size(32, False, None), [fit.name for fit in model.fits][:2]
        (1024, ['analytic', 'linear'])
    """

    name: str
    summary: str
    kind: type[TransferModel]
    fits: tuple[Fit, ...]
    size: Callable[[int, bool, Any], int]
    usual: str = ""
    climbed_by: str | None = None
    default: bool = False
    basis: Callable[[Sample], Tensor] | None = None
    needs_long_time: bool = False
    needs_strength: bool = False
    fits_loss: bool = False
    rungs: Callable[[int], Sequence[Any]] = lambda n_times: (NoSettings(),)
    tried_on: Callable[[Scene | None], bool] = lambda scene: True
    check_scene: Callable[[Scene | None], Any] = lambda scene: None
    windows: tuple[float, ...] = ()
    near: float = 1.25
    never_negative: bool = False
    slow: bool = False
    replicas: Callable[[BandTransfer, Recipe, Any, Tensor], Iterator[TransferModel]] | None = None

    def __post_init__(self) -> None:
        for name in (self.name, *(fit.name for fit in self.fits)):
            if not isinstance(name, str) or not name.isidentifier():
                raise checks.fail("name", "be an identifier", name)
        if not self.fits:
            raise checks.fail("fits", "be at least one", 0)
        names = [fit.name for fit in self.fits]
        for field in ("usual", "climbed_by"):
            if getattr(self, field):
                checks.choice(field, getattr(self, field), names)
        axes = getattr(self.kind, "axes", None)
        if not isinstance(getattr(self.kind, "kind", None), str) or not isinstance(axes, dict):
            raise checks.fail("kind", "be a TransferModel that states its kind and axes", self.kind)
        wanted = {"basis": ("band", "band"), "damping": ("band",)}  # tensors of the file, or what follows from these
        if any(axes[n] != a if n in axes else not hasattr(self.kind, n) for n, a in wanted.items()):
            raise checks.fail("kind", "have a basis (band, band) and damping (band)", axes)

    def fit(self, name: str = "") -> Fit:
        """The fit of a name; of none, the usual one."""
        name = name or self.usual or self.fits[0].name
        return next(fit for fit in self.fits if fit.name == name)

    def describes(self, scene: Scene | None) -> bool:
        """Whether it can describe the chains of a scene."""
        try:
            self.check_scene(scene)
        except checks.FieldError:
            return False
        return True

    def suits(self, long_time: bool, strength: bool, damped: bool) -> bool:
        """Whether what it needs is at hand."""
        late = not self.needs_long_time or long_time or (damped and self.fits_loss)
        return late and (strength or not self.needs_strength)


@dataclass(frozen=True)
class Recipe:
    """A calibration in every detail: what ``calibrate`` makes of its arguments.

    Attributes:
        model, fit: records; None: to be chosen.
        window: of the fits at short times.
        settings: an instance of ``fit.settings``.

    Example:
        >>> tc.Recipe(model=None, fit=None, window=(0.5, 2.0)).window
        (0.5, 2.0)
    """

    model: ReducedModel | None
    fit: Fit | None
    window: tuple[float, float]
    settings: Any = NoSettings()

    @property
    def order(self) -> tuple[int, ...]:
        """Of a model that comes in several sizes, its order or degrees; empty for others."""
        return tuple(getattr(self.settings, "order", None) or getattr(self.settings, "degrees", None) or ())

    @property
    def complete(self) -> bool:
        sizes = (getattr(self.settings, name, 0) for name in ("order", "degrees"))
        return self.model is not None and all(size is not None for size in sizes)

    def run(self, sample: Sample, near: TransferModel | None = None, progress: Progress = None) -> Fitted:
        """Fit the model to a sample, starting from the model of a similar one if there is one."""
        assert self.fit is not None, "calibrate names one"
        return self.fit.run(sample, self, near, progress)
