"""The plan against measurement: 100 varied scenes, every method that can treat each, predicted and measured seconds and error."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import checks
from torchchain.ensemble import plan as planning
from torchchain.ensemble.plan import Choice
from torchchain.ensemble.predictions import Facts, cost, error_of, settle
from torchchain.ensemble.scene_file import regular_times
from torchchain.ensemble.scene_words import describe
from torchchain.evolvers import METHODS

IN_SPACE = ("center", "width", "energy", "displacement", "total_energy", "source_energy")
LAWS = ("linear",) * 10 + ("auto",) * 2 + ("damped",) * 3 + ("hertz",) * 4 + ("hertz damped",)
STIFFNESS = (None, tc.Disorder("gamma", 1.0), None, tc.Disorder("lognormal", 0.9), None)  # of the scenes, by twenties
WAYS = (
    "modes", "tridiagonal", "chebyshev", "verlet", "verlet float32", "symplectic4", "symplectic4 float32", "damped",
    "dopri8",
)  # fmt: skip
LOOKS = dict(zip(WAYS, ("C0", "C1", "C2", "C3", "C3", "C4", "C4", "C5", "C6"), strict=True))


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the scenes and of their chains"""
    scenes: int = 100
    """varied scenes"""
    repeats: int = 3
    """timed runs of each way, after one that is not counted"""
    work: float = 0.08
    """rough seconds that a scene is made to take by the stencil"""
    longest: float = 4.0
    """largest chain, in factors of 1024 particles"""
    patience: float = 1.0
    """a way predicted to take longer than this many seconds and ten times the fastest is not run"""
    within: float = 1.5
    """the choice is good if it takes at most this many times the fastest"""


SMOKE = Config(scenes=4, repeats=1, work=0.002, longest=0.1, patience=0.05)


def varied(config: Config, number: int) -> tc.Scene:
    """Scene ``number`` of the grid: law, size, disorder, times, start, observables and tolerance drawn from the seed."""
    draw = np.random.Generator(np.random.Philox(key=np.array([config.seed, number], dtype=np.uint64)))
    law = LAWS[number % len(LAWS)]
    hertz, damping = law.startswith("hertz"), 0.05 if law.endswith("damped") else 0.0
    largest = np.log2(512 * config.longest)
    n = 2 * round(2 ** draw.uniform(4, min(largest, 7) if damping else largest))  # no faster reference for long ones
    boundary = str(draw.choice(["periodic", "fixed"]))
    strength = float(draw.choice([0.0, 0.1, 0.3, 0.5], p=[0.1, 0.3, 0.3, 0.3]))
    stiffness = STIFFNESS[number // len(LAWS) % len(STIFFNESS)]
    end = 10 ** draw.uniform(1, 3.7 if law == "linear" else 2.2)
    count = int(draw.choice([1, 8, int(2 ** draw.uniform(5, 9))]))
    tolerance = draw.choice([1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 0.0])
    if law != "linear" and tolerance > 0:
        tolerance = max(tolerance, 1e-8)
    bands = not hertz and law != "auto" and draw.random() < 0.4
    wave, n_bands = bands or draw.random() < 0.5, int(draw.choice([4, 8, 16]))
    names = ("band_energy",) if bands else tuple(map(str, draw.choice(IN_SPACE, int(draw.choice([1, 2])), False)))
    n = max(2, n // (2 * n_bands)) * 2 * n_bands if bands else n
    excitation: tc.Impulse | tc.StandingWave
    if bands:
        rows, excitation = n_bands, tc.StandingWave()
    elif wave:
        tones = sorted({int(tone) for tone in draw.integers(1, n // 2, int(draw.choice([1, 4])))})
        rows, excitation = len(tones), tc.StandingWave(tones=tuple(tones), amplitude=0.2 if hertz else 0.01)
    else:
        rows, excitation = 1, tc.Impulse(site=int(draw.choice([1, n // 2])), velocity=0.3 if hertz else 0.01)
    cost = rows * n * (end * (3e-9 if law == "linear" else 6e-8) + count * 2e-8)  # about a chain's seconds
    realizations = min(config.work / cost, int(draw.choice([2, 8, 32] if law == "linear" else [1, 2, 4])))
    if realizations < 1:
        end = max(10.0, end * realizations)
    realizations = max(2 if tolerance == 0 else 1, int(realizations))
    if law == "auto":  # from where linear contacts will do to where they will not
        tolerance, size = max(tolerance, 1e-4), 10 ** draw.uniform(-4, -0.7)
        excitation = replace(excitation, **{"amplitude" if wave else "velocity": size})
    return tc.Scene(
        n_particles=n, boundary=boundary, disorder=tc.Disorder(strength=strength), excitation=excitation,
        times=torch.tensor([end]) if count == 1 else regular_times(0.0, end, end / (count - 1)), n_bands=n_bands,
        realizations=realizations, seed=config.seed, tolerance=float(tolerance) or None, observables=names,
        contact="hertz" if hertz else "auto" if law == "auto" else "linear", damping=damping,
        stiffness_disorder=stiffness, energy_definition="bond" if law == "auto" else "site",
    )  # fmt: skip


def reachable(scene: tc.Scene) -> tc.Scene:
    """The scene with its tolerance ten times looser, and again, where no method reaches it."""
    try:
        planning.plan(scene)
    except checks.FieldError:
        return reachable(replace(scene, tolerance=10 * scene.tolerance))
    return scene


def way_of(choice: Choice) -> str:
    return choice.method + (" float32" if choice.dtype == torch.float32 else "")


def run(scene: tc.Scene, choice: Choice) -> xarray.Dataset:
    options = dict(choice.options)
    if choice.dtype == torch.float32:
        options["dtype"] = "float32"
    return tc.simulate(scene, choice.method, options=options)


def timed(
    scene: tc.Scene, choices: list[Choice], repeats: int, within: float
) -> dict[str, tuple[float, xarray.Dataset]]:
    """Median processor time and result of each way, taken in turn, so that a slow spell of the machine meets them all.

    A way that took more than twice as many times the fastest as is good is not repeated: nothing hangs on it.
    """
    spent: dict[str, list[float]] = {}
    results = {}
    for choice in choices:
        begin = time.process_time()
        results[way_of(choice)] = run(scene, choice)
        spent[way_of(choice)] = [time.process_time() - begin]
    for _ in range(repeats):
        for choice in choices:
            samples = spent[way_of(choice)]
            if samples[-1] > 2 * within * min(map(min, spent.values())) and samples[-1] > 0.05:
                continue
            begin = time.process_time()
            run(scene, choice)
            samples.append(time.process_time() - begin)
    return {name: (float(np.median(s[1:] or s)), results[name]) for name, s in spent.items()}


def references(scene: tc.Scene) -> dict[str, Choice]:
    """For each family of methods another one, at the tightest accuracy that is worth it, to measure its error by."""
    facts = Facts(scene)
    tolerance = (scene.tolerance or planning.plan(scene).tolerance) / 10

    def tight(method: str, **options: float) -> Choice:
        found = options or settle(method, facts, tolerance, torch.float64)[0]
        if not METHODS[method].candidate:
            return Choice(method, found, tolerance, 0.0, 0.0, tolerance)
        off = error_of(method, facts, found, torch.float64)
        work = facts.chains * cost(method, facts, found, torch.float64, facts.chains)
        return Choice(method, found, off, work, work * planning.speed(), tolerance)

    if scene.damping == 0 and scene.contact == "linear":
        by_matrix = "modes" if scene.boundary == "periodic" else "tridiagonal"
        others = min((tight(by_matrix), tight("symplectic4")), key=lambda choice: choice.predicted_seconds)
        return {"chebyshev": others, "": tight("chebyshev", accuracy=1e-14)}
    adaptive = tight("dopri8")
    if scene.damping > 0 and scene.contact == "linear":
        exact = tight("damped")
        return {"damped": adaptive, "": exact if exact.predicted_seconds < 10 else adaptive, "dopri8": exact}
    if scene.damping > 0:
        return {"verlet": adaptive, "": tight("dopri5", rtol=adaptive.options["rtol"])}
    other = min((adaptive, tight("verlet")), key=lambda choice: choice.predicted_seconds)
    return {"symplectic4": other, "": tight("symplectic4")}


def error(found: xarray.Dataset, exact: xarray.Dataset, names: tuple[str, ...]) -> float:
    """Largest difference of any observable, relative to its own largest value."""
    return max(float(abs(found[name] - exact[name]).max() / abs(exact[name]).max()) for name in names)


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', whose costs the plan knows", repr(device))
    for number in range(min(config.scenes, len(LAWS))):  # load and compile what the methods use
        small = varied(replace(config, longest=0.05, work=1e-6), number)
        for choice in planning.plan(small).choices:
            if choice.good and choice.predicted_seconds < 1:
                run(small, choice)
    shape = (config.scenes, len(WAYS))
    table = {
        name: np.full(shape, np.nan)
        for name in ("seconds", "predicted_seconds", "error", "predicted_error", "reference_error")
    }
    chosen, tolerances, words, plan_seconds = [], [], [], []
    for i in range(config.scenes):
        scene = reachable(varied(config, i))
        begin = time.perf_counter()
        plan = planning.plan(scene)
        plan_seconds.append(time.perf_counter() - begin)
        true = replace(scene, contact="hertz") if scene.contact == "auto" else scene
        fastest = min(choice.predicted_seconds for choice in plan.choices)
        for choice in plan.choices:
            at = i, WAYS.index(way_of(choice))
            table["predicted_seconds"][at], table["predicted_error"][at] = (
                choice.predicted_seconds,
                choice.predicted_error,
            )
        run_now = [
            choice
            for choice in plan.choices
            if choice.good and choice.predicted_seconds <= max(config.patience, 10 * fastest)
        ]
        exact: dict[str, xarray.Dataset] = {}
        by = references(true)
        for name, (spent, result) in timed(plan.scene, run_now, config.repeats, config.within).items():
            reference = by.get(name.partition(" ")[0], by[""])
            if reference.method not in exact:
                exact[reference.method] = run(true, reference)
            at = i, WAYS.index(name)
            table["seconds"][at] = spent
            table["reference_error"][at] = reference.predicted_error
            table["error"][at] = error(result, exact[reference.method], scene.observables)
        chosen.append(WAYS.index(way_of(plan.choices[0])))
        tolerances.append(plan.tolerance)
        words.append(
            f"{describe(scene)}, {', '.join(scene.observables)}, {scene.contact} contacts, in the run {plan.scene.contact}, damping {scene.damping:g}"
        )
    return xarray.Dataset(
        {
            **{
                name: (("scene", "way"), values, {"units": "s" if "seconds" in name else "scale of the observable"})
                for name, values in table.items()
            },
            "chosen": ("scene", chosen),
            "tolerance": ("scene", tolerances),
            "words": ("scene", words),
            "plan_seconds": ("scene", plan_seconds, {"units": "s"}),
        },
        coords={"way": list(WAYS)},
    )


def ratios(data: xarray.Dataset) -> np.ndarray:
    """Seconds of the choice over those of the fastest way that kept to the tolerance as measured, per scene."""
    allowed = (data.error <= data.tolerance).values
    best = np.where(allowed, data.seconds.values, np.inf)
    rows = np.arange(len(best))
    own = data.seconds.values[rows, data.chosen.values]
    return own / np.minimum(own, best.min(axis=1))


def of_choice(data: xarray.Dataset, name: str) -> np.ndarray:
    return data[name].values[np.arange(data.sizes["scene"]), data.chosen.values]


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    ratio, errors, tolerance = ratios(data), of_choice(data, "error"), data.tolerance.values
    spent, predicted = of_choice(data, "seconds"), of_choice(data, "predicted_seconds")
    ran, usable = np.isfinite(data.seconds.values), np.isfinite(data.predicted_seconds.values)
    within = np.abs(np.log(predicted / spent))
    every = np.abs(np.log(data.predicted_seconds.values / data.seconds.values))[ran]
    optimistic = (data.error > data.predicted_error + data.reference_error).values[ran]
    rows = [
        Row("scenes", data.sizes["scene"]),
        Row(
            f"share of scenes whose choice takes at most {config.within:g} times the fastest",
            float((ratio <= config.within).mean()),
        ),
        Row("share of scenes whose choice keeps to the tolerance", float((errors <= tolerance).mean())),
        Row("worst ratio to the fastest", float(ratio.max())),
        Row("mean ratio to the fastest", float(ratio.mean())),
        Row("predicted and measured seconds of the choice: typical factor between", float(np.exp(np.median(within)))),
        Row("the same, nine scenes in ten", float(np.exp(np.quantile(within, 0.9)))),
        Row("predicted and measured seconds of every way: typical factor between", float(np.exp(np.median(every)))),
        Row("share of runs with an error above the predicted and the reference's", float(optimistic.mean())),
        Row("ways that were run", int(ran.sum())),
        Row("ways left out as predicted far slower or too coarse", int((usable & ~ran).sum())),
        Row("seconds of the plan itself, median", float(np.median(data.plan_seconds))),
    ]
    names, counts = np.unique(data.chosen.values, return_counts=True)
    rows += [Row(f"chosen: {WAYS[name]}", int(count)) for name, count in zip(names, counts, strict=True)]
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 3, width=4.6, height=4.0)
    ratio = ratios(data)
    ax = axes[0, 0]
    ax.plot(np.sort(ratio), (np.arange(len(ratio)) + 1) / len(ratio), drawstyle="steps-post", color="k")
    ax.axvline(config.within, color="C3", linestyle="--", label=f"{config.within:g} times")
    ax.axhline(0.9, color="0.6", linestyle=":", label="nine scenes in ten")
    ax.set(
        xlabel="seconds, choice / fastest", ylabel="share of scenes", ylim=(0, 1.02),
        title="how good the choice is",
    )  # fmt: skip
    ax.legend(loc="lower right", fontsize="small")
    for ax, measured, predicted, unit in (
        (axes[0, 1], "seconds", "predicted_seconds", "seconds"),
        (axes[0, 2], "error", "predicted_error", "error / scale"),
    ):
        low, high = np.inf, 0.0
        for j, way in enumerate(WAYS):
            x, y = data[predicted].values[:, j], np.maximum(data[measured].values[:, j], 1e-17)
            x = x + (data.reference_error.values[:, j] if measured == "error" else 0.0)  # which is measured, too
            here = np.isfinite(data[measured].values[:, j])
            if not here.any():
                continue
            marker = "x" if way.endswith("float32") else "o"
            ax.plot(x[here], y[here], marker, color=LOOKS[way], markersize=3.5, label=way, alpha=0.7)
            low, high = min(low, x[here].min(), y[here].min()), max(high, x[here].max(), y[here].max())
        ax.plot([low, high], [low, high], "k-", linewidth=0.8)
        ax.set(xscale="log", yscale="log", xlabel=f"predicted {unit}", ylabel=f"measured {unit}")
    axes[0, 1].set(title="every way that was run")
    axes[0, 2].set(title="predictions are bounds", xlabel="predicted error / scale,\nwith the reference's")
    axes[0, 1].legend(fontsize="x-small")
    return figure


def slow_choices(data: xarray.Dataset, config: Config) -> Iterator[str]:
    """The scenes whose choice was slow or too coarse, worst first."""
    ratio, errors = ratios(data), of_choice(data, "error")
    bad = (ratio > config.within) | (errors > data.tolerance.values)
    for i in sorted(np.flatnonzero(bad), key=lambda i: -ratio[i]):
        allowed = (data.error[i] <= data.tolerance[i]).values
        best = WAYS[int(np.where(allowed, data.seconds.values[i], np.inf).argmin())]
        yield (
            f"scene {i}: {ratio[i]:.2f} times {best}, error {errors[i]:.1e} of {float(data.tolerance[i]):.1e} allowed, by "
            f"{WAYS[int(data.chosen[i])]}: {data.words.values[i]!s}"
        )


def explain(data: xarray.Dataset, config: Config) -> str:
    words = (
        "Each scene is run by every way that the plan predicts to keep to the tolerance, in turn, with the options that the "
        "plan would give it; the fastest is the best of those that kept to it as measured. Errors are measured against "
        "another method at a tenth of the tolerance or at rounding."
    )
    worst = list(slow_choices(data, config))
    return words + ("\nThe choice was slow or too coarse in:\n" + "\n".join(worst) if worst else "")


SCRIPT = harness.Script("plan_grid", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # amplitudes are the grid's own affair
        return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
