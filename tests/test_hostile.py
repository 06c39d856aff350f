"""Anything at all as any argument of any public function: a typed error that names it, or a finite answer."""

import dataclasses
import math
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from taken import LITTLE, Taken

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.evolvers import ode
from torchchain.evolvers.energy_guard import EnergyDriftError
from torchchain.master import IntegrationError
from torchchain.modes.spectrum import DecompositionError

FAILED = (DecompositionError, EnergyDriftError, IntegrationError, ode.IntegrationError)
"""Solvers that say which check a result of theirs has not passed."""

settings.register_profile(
    "same_every_time", derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)
settings.load_profile("same_every_time")


# Arguments that are right, from which one at a time is taken for a hostile value


@cache
def chain(boundary="periodic", **more):
    return tc.Chain(torch.tensor([[0.9, 1.2, 1.0, 0.7], [1.1, 0.8, 1.3, 1.0]], dtype=torch.float64), boundary, **more)


@cache
def state():
    return tc.standing_wave(chain(), 1, 0.01)


@cache
def trajectory():
    return tc.evolve(chain(), state(), [0.0, 1.0, 2.0])


@cache
def scene(**more):
    few = {"n_particles": 16, "n_bands": 4, "realizations": 8, "times": np.arange(0, 6.01, 0.5)}
    return tc.Scene(**few | {name: tc.Disorder(strength=x) if name == "disorder" else x for name, x in more.items()})


@cache
def transfer(strength=0.3):
    return tc.band_transfer(scene(disorder=strength), "modes")


@cache
def small_transfer():
    """Of few energies, for a fit to which each costs time."""
    return tc.band_transfer(scene(disorder=0.3, n_bands=2, times=(0.0, 3.0)), "modes")


@cache
def master():
    return tc.calibrate(transfer(), bootstrap=2, order=(1, 1))


@cache
def rates_alone():
    return tc.calibrate(transfer(), "linear", "basis_matrix", bootstrap=0)


@cache
def family():
    return tc.calibrate_family([transfer(xi) for xi in (0.1, 0.2, 0.3)], order=(1, 0), bootstrap=2)


def memory():
    return {name: value.detach() for name, value in master().model.tensors().items()}


EYE = torch.eye(4, dtype=torch.float64)
START = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
ENERGY = torch.tensor([[0.1, 0.2, 0.3, 0.1]], dtype=torch.float64)
TIMES = [0.0, 1.0, 2.0]


@dataclasses.dataclass(frozen=True)
class Call:
    """A public function, arguments that it takes, and other words by which its errors name them."""

    of: object
    given: object
    named: dict = dataclasses.field(default_factory=dict)
    infinite: bool = False

    def arguments(self):
        return self.given() if callable(self.given) else dict(self.given)

    def given_names(self):
        return sorted(self.arguments())


DISORDER = dict.fromkeys(("kind", "strength", "lower"), ("disorder",))
RUN = {"device": "cpu", "memory_budget": None, "options": None}
CALLS = {
    "BandTransfer": Call(tc.BandTransfer, lambda: {f.name: getattr(transfer(), f.name) for f in dataclasses.fields(tc.BandTransfer)}, {"times": ("mean",), "block_counts": ("block_mean",), "scene": ("mean",)}, infinite=True),
    "Chain": Call(tc.Chain, {"masses": [[1.0, 2.0, 1.0]], "boundary": "fixed", "stiffness": 1.0, "contact": "linear", "damping": 0.0}),
    "Disorder": Call(tc.Disorder, {"kind": "gamma", "strength": 0.3, "lower": 0.05}, DISORDER),
    "Disorder.masses": Call(lambda **k: tc.Disorder().masses(**k), {"n_particles": 4, "realizations": 2, "seed": 0}),
    "Disorder.stiffnesses": Call(lambda **k: tc.Disorder().stiffnesses(**k), {"n_contacts": 4, "realizations": [0, 5], "seed": 0}),
    "Impulse": Call(tc.Impulse, {"site": 1, "velocity": 0.01}),
    "MasterEquation": Call(tc.MasterEquation, lambda: {"model": master().model, "calibration": master().calibration, "uncertainty": master().uncertainty}),
    "MasterEquation.solve": Call(lambda **k: master().solve(**k), {"initial": START, "times": TIMES, "method": "expm", "supply": START}),
    "MasterEquation.solve by dopri5": Call(lambda **k: master().solve(method="dopri5", **k), {"initial": START, "times": TIMES, "rtol": 1e-6, "atol": 1e-8}),
    "MasterEquation.solve by rk4": Call(lambda **k: rates_alone().solve(method="rk4", **k), {"initial": START, "times": TIMES, "step": 0.1}),
    "MasterEquation.standard_error": Call(lambda **k: master().standard_error(**k), {"initial": START, "times": TIMES}),
    "MasterEquation.dissipated": Call(lambda **k: rates_alone().dissipated(**k), {"initial": START, "times": TIMES}),
    "MasterEquation.concerns": Call(lambda **k: master().concerns(**k), lambda: {"scene": scene()}),
    "MasterEquation.coarsened": Call(lambda **k: master().coarsened(**k).basis, {"n_bands": 2}),
    "MasterFamily": Call(tc.MasterFamily, lambda: {"members": list(family().members)}),
    "MasterFamily.at": Call(lambda **k: family().at(**k).basis, {"strength": 0.15}),
    "MasterFamily.weights": Call(lambda **k: family().weights(**k), {"strength": 0.15}),
    "MasterFamily.solve": Call(lambda **k: family().solve(**k), {"initial": START, "times": TIMES, "strength": 0.15, "method": "expm"}),
    "MasterFamily.leave_one_out": Call(lambda **k: family().leave_one_out(**k), {"times": TIMES}),
    "MemoryModel": Call(tc.MemoryModel, memory, {"pair_frequency": ("amplitudes",), "decay": ("amplitudes",), "pair_decay": ("amplitudes",), "basis": ("amplitudes",), "rates": ("basis", "amplitudes")}),
    "NormalModes": Call(lambda **k: tc.evolve(chain(), state(), TIMES, "modes", modes=tc.NormalModes(**k)), lambda: {"frequencies": tc.normal_modes(chain()).frequencies, "shapes": tc.normal_modes(chain()).shapes}, {"frequencies": ("modes", "times"), "shapes": ("modes",)}),
    "RateModel": Call(tc.RateModel, {"rates": 0 * EYE, "basis": EYE, "damping": 0 * START}, {"rates": ("basis", "damping")}),
    "Scaling": Call(tc.Scaling, {"radius": 0.01, "density": 7800.0, "young_modulus": 2e11, "poisson_ratio": 0.3, "force": 10.0}, dict.fromkeys(("radius", "density", "young_modulus", "poisson_ratio"), ("si",))),
    "Scene": Call(tc.Scene, lambda: {f.name: getattr(scene(), f.name) for f in dataclasses.fields(tc.Scene)}, {"n_particles": ("n_bands", "excitation"), "damping": ("observables",)}),
    "SwingInModel": Call(tc.SwingInModel, {"rates": 0 * EYE, "basis": EYE, "delay": 1.0, "damping": 0 * START}, {"rates": ("basis", "damping", "delay")}),
    "StandingWave": Call(tc.StandingWave, {"tones": (1, 2), "amplitude": 0.01, "phase": "sin"}),
    "State": Call(tc.State, {"displacement": [0.0, 1.0], "velocity": [0.0, 0.0]}, {"displacement": ("velocity",)}),
    "Trajectory": Call(lambda **k: tc.total_energy(chain(), tc.Trajectory(**k)), lambda: {"times": trajectory().times, "displacement": trajectory().displacement, "velocity": trajectory().velocity}, {"displacement": ("trajectory",), "velocity": ("trajectory",)}),
    "band_energy": Call(tc.band_energy, lambda: {"chain": chain(), "trajectory": trajectory(), "n_bands": 2, "normalize": True, "definition": "site"}),
    "band_transfer": Call(tc.band_transfer, lambda: {"scene": scene(realizations=2), "method": "modes", "long_time": True, **RUN, "checkpoint": None}),
    "basis_fraction": Call(tc.basis_fraction, {"strength": 0.3, "n_bands": 4}),
    "bin_energy": Call(tc.bin_energy, {"energy": [[0.0, 1.0, 2.0, 3.0, 4.0]], "n_bands": 2}, {"energy": ("n_bands", "n_particles")}),
    "calibrate": Call(tc.calibrate, lambda: {"transfer": transfer(), "method": "linear", "model": "paper", "window": (0.5, 2.0), "bootstrap": 0}),
    "calibrate by adam": Call(lambda **k: tc.calibrate(transfer(), "adam", "paper", **k), {"constraint": "penalty", "penalty": 1.0, "steps": 3, "learning_rate": 0.3, "tolerance": 1e-4}),
    "calibrate by projection": Call(lambda **k: tc.calibrate(transfer(), "projection", **k), {"order": (1, 0), "bootstrap": 0}),
    "calibrate_family": Call(lambda **k: tc.calibrate_family(bootstrap=0, **k).strengths, lambda: {"transfers": [transfer(0.1), transfer(0.2)], "order": (1, 0)}),
    "chapman_kolmogorov": Call(tc.chapman_kolmogorov, lambda: {"transfer": transfer(), "lag": 0.5, "multiples": (1, 2)}, {"lag": ("multiples",)}),
    "count_modes_below": Call(tc.count_modes_below, lambda: {"chain": chain(), "frequencies": [0.5, 1.5]}),
    "energy_center": Call(tc.energy_center, {"energy": ENERGY}),
    "energy_matrices": Call(tc.energy_matrices, lambda: {"chain": chain(), "trajectory": trajectory()}),
    "energy_moments": Call(tc.energy_moments, lambda: {"chain": chain(), "state": state(), "times": TIMES, "definition": "site", "accuracy": 1e-9}),
    "energy_width": Call(tc.energy_width, {"energy": ENERGY}),
    "evolve": Call(tc.evolve, lambda: {"chain": chain(), "state": state(), "times": TIMES, "method": "modes"}),
    "evolve by chebyshev": Call(lambda **k: tc.evolve(chain(), state(), TIMES, "chebyshev", **k), {"accuracy": 1e-9, "bound": 10.0, "compiled": True}),
    "evolve by dopri5": Call(lambda **k: tc.evolve(chain(), state(), TIMES, "dopri5", **k), {"rtol": 1e-6, "atol": 1e-9}),
    "evolve by rk4": Call(lambda **k: tc.evolve(chain(), state(), TIMES, "rk4", **k), {"step": 0.1}),
    "evolve by verlet": Call(lambda **k: tc.evolve(chain(), state(), TIMES, "verlet", **k), {"step": 0.1}),
    "implied_timescales": Call(tc.implied_timescales, lambda: {"transfer": transfer(), "lags": [0.5, 1.0]}, infinite=True),
    "impulse": Call(tc.impulse, lambda: {"chain": chain(), "site": 1, "velocity": 0.01}),
    "integrated_density_of_states": Call(tc.integrated_density_of_states, {"disorder": tc.Disorder(), "frequencies": [0.5], "n_particles": 8, "realizations": 2, "seed": 0}),
    "kinetic_energy": Call(tc.kinetic_energy, lambda: {"chain": chain(), "trajectory": trajectory()}),
    "linearity": Call(tc.linearity, lambda: {"chain": chain(), "states": state()}),
    "long_time_band_energy": Call(tc.long_time_band_energy, lambda: {"chain": chain(), "state": state(), "n_bands": 2, "normalize": True, "modes": None, "definition": "site"}),
    "lyapunov_exponent": Call(tc.lyapunov_exponent, {"disorder": tc.Disorder(), "frequencies": [0.5], "n_particles": 8, "realizations": 2, "seed": 0, "stiffness_disorder": None}),
    "normal_modes": Call(tc.normal_modes, lambda: {"chain": chain()}),
    "particle_energy": Call(tc.particle_energy, lambda: {"chain": chain(), "trajectory": trajectory(), "definition": "bond"}),
    "plan": Call(tc.plan, lambda: {"scene": scene(), "artifact": None}, {"artifact": ("file",)}, infinite=True),
    "potential_energy": Call(tc.potential_energy, lambda: {"chain": chain(), "trajectory": trajectory(), "definition": "site"}),
    "Network": Call(tc.Network, {"masses": [1.0, 1.0, 2.0], "positions": [[0.0, 0.0], [1.0, 0.0], [0.5, 0.8]], "bonds": [[0, 1], [1, 2], [2, 0]], "stiffness": 1.0, "tension": 0.0, "box": None, "motion": "vector"}, {"masses": ("positions", "bonds"), "positions": ("masses", "bonds")}, infinite=True),  # a box is endless along an open axis
    "estimate_disorder": Call(tc.estimate_disorder, lambda: {"transfer": small_transfer(), "kind": "normal", "lower": 0.05, "guess": 0.2}, {"kind": ("disorder",), "lower": ("disorder",)}),
    "lattice": Call(tc.lattice, {"kind": "square", "shape": (3, 4), "motion": "scalar", "boundary": "periodic"}),
    "open": Call(tc.open, {"folder": "nothing"}),
    "packing": Call(tc.packing, {"positions": [[0.0, 0.0], [0.9, 0.0], [0.4, 0.8]], "radii": [0.5, 0.5, 0.5], "masses": [1.0, 1.0, 1.0], "box": None, "stiffness": 1.0, "contact": "linear"}, {"radii": ("positions",), "masses": ("positions",), "positions": ("radii", "masses")}, infinite=True),  # a box is endless along an open axis
    "paper_rates": Call(lambda **k: tc.paper_rates(**k).rates.values, lambda: {"transfer": transfer(), "window": (0.5, 2.0)}),
    "read_frames": Call(tc.read_frames, {"path": "nothing", "contacts": None, "format": None}, {"contacts": ("nothing",), "format": ("nothing",)}),
    "simulate": Call(tc.simulate, lambda: {"scene": scene(realizations=2), "method": "modes", **RUN, "checkpoint": None}),
    "standing_wave": Call(tc.standing_wave, lambda: {"chain": chain(), "tone": 1, "amplitude": 0.01, "phase": "sin"}),
    "statistical_distance": Call(tc.statistical_distance, {"stderr": ENERGY}, infinite=True),
    "total_energy": Call(tc.total_energy, lambda: {"chain": chain(), "trajectory": trajectory()}),
    "total_variation": Call(tc.total_variation, {"p": START, "q": START}, {"p": ("q",), "q": ("p",)}),
    "wavenumber_energy": Call(tc.wavenumber_energy, lambda: {"chain": chain(), "trajectory": trajectory(), "definition": "site"}),
    "wavenumber_energy_matrix": Call(tc.wavenumber_energy_matrix, lambda: {"matrices": tc.energy_matrices(chain(), trajectory())}),
    "weak_disorder_lyapunov": Call(tc.weak_disorder_lyapunov, {"strength": 0.3, "frequencies": [0.5]}),
    "zero_wavenumber_share": Call(tc.zero_wavenumber_share, lambda: {"chain": chain(), "trajectory": trajectory()}),
}  # fmt: skip


def test_every_public_function_is_here():
    records = {"EnergyMoments", "Linearity", "Plan"}  # results alone
    registries = {
        "METHODS",
        "MODELS",
        "OBSERVABLES",
        "SOLVERS",
        "register_method",
        "register_model",
        "register_observable",
    }
    kinds = {
        *registries, "Advance", "DecompositionError", "FieldError", "FieldTypeError", "FitWarning", "Frames", "LinearityWarning",
        "Method", "Observable", "ReducedModel", "RunFolder", "SpectrumWarning", "PredictionWarning", "localization",
    }  # fmt: skip
    assert set(tc.__all__) - records - kinds <= set(CALLS)


# Hostile values


class Odd:
    """An object that is nothing."""

    def __repr__(self):
        return "Odd"


def tensors(dtype=torch.float64):
    return {
        "empty": torch.zeros(0, dtype=dtype),
        "empty rows": torch.zeros(3, 0, dtype=dtype),
        "scalar": torch.tensor(0.5, dtype=dtype),
        "zeros": torch.zeros(4, dtype=dtype),
        "negative": -torch.ones(4, dtype=dtype),
        "nan": torch.tensor([math.nan, 1, 1, 1], dtype=dtype),
        "inf": torch.tensor([1, math.inf, 1, 1], dtype=dtype),
        "huge": torch.full((4,), 1e300 if dtype == torch.float64 else 1e38, dtype=dtype),
        "tiny": torch.full((4,), 1e-300 if dtype == torch.float64 else 1e-38, dtype=dtype),
        "unsorted": torch.tensor([2.0, 1.0, 0.0, 3.0], dtype=dtype),
        "short": torch.ones(3, dtype=dtype),
        "deep": torch.ones(1, 2, 3, 4, dtype=dtype),
        "square": torch.full((4, 4), 0.25, dtype=dtype),
        "huge square": torch.full((4, 4), 1e300 if dtype == torch.float64 else 1e38, dtype=dtype),
    }


VALUES = {
    "None": None, "True": True, "False": False, "word": "word", "empty word": "", "bytes": b"x", "object": Odd(), "type": int,
    "function": len, "complex": 1j, "nan": math.nan, "inf": math.inf, "-inf": -math.inf, "0": 0, "-1": -1, "1": 1, "3": 3, "0.0": 0.0,
    "2.5": 2.5, "-2.5": -2.5, "1e-300": 1e-300, "1e300": 1e300, "-1e300": -1e300, "5e-324": 5e-324, "2^31": 2**31, "2^63": 2**63, "2^64": 2**64,
    "-2^63": -(2**63), "10^400": 10**400, "a line\nmore": "a line\nmore", "list": [], "tuple": (), "dict": {}, "set": {1.0}, "nested": [[]],
    "ragged": [[1.0], [1.0, 2.0]], "words": ["a", "b"], "nones": [None, 1.0], "nans": [math.nan, 1.0], "huge ones": [10**400, 1],
    "table": {"a": 1}, "range": range(3), "iterator": iter([]), "numpy text": np.array(["a"]), "numpy objects": np.array([Odd()]),
    "numpy complex": np.ones(4) * 1j, "numpy float16": np.float16(1), "numpy int": np.int64(-3), "numpy nan": np.array([np.nan]), "path": Path("nothing/here"),
    "dates": np.array(["2020-01-01"], dtype="datetime64[D]"),
    "integers": torch.ones(4, dtype=torch.int64), "truths": torch.ones(4, dtype=torch.bool), "complexes": torch.ones(4, dtype=torch.complex128),
    "half": torch.ones(4, dtype=torch.float16), "bytes of a tensor": torch.ones(4, dtype=torch.uint8), "elsewhere": torch.ones(4, device="meta", dtype=torch.float64),
    "sparse": torch.eye(4, dtype=torch.float64).to_sparse(),
    **{f"tensor {name}": value for name, value in tensors().items()},
    **{f"single {name}": value for name, value in tensors(torch.float32).items()},
}  # fmt: skip


# What must come of them


def numbers(result, depth=0):
    """All numbers of an answer, by the way to them."""
    if isinstance(result, torch.nn.Module):
        result = dict(result.named_buffers()) | dict(result.named_parameters())
    if isinstance(result, torch.Tensor):
        yield "tensor", result.detach()
    elif isinstance(result, xarray.Dataset):
        for name in result.data_vars:
            yield name, torch.from_numpy(np.asarray(result[name].values))
    elif isinstance(result, float):
        yield "number", torch.tensor(result, dtype=torch.float64)
    elif isinstance(result, dict):
        for name, value in result.items():
            yield from ((f"{name}.{way}", x) for way, x in numbers(value, depth + 1))
    elif isinstance(result, (list, tuple)):
        for i, value in enumerate(result):
            yield from ((f"{i}.{way}", x) for way, x in numbers(value, depth + 1))
    elif dataclasses.is_dataclass(result) and not isinstance(result, type) and depth < 3:
        for entry in dataclasses.fields(result):
            yield from ((f"{entry.name}.{way}", x) for way, x in numbers(getattr(result, entry.name), depth + 1))


def verdict(name, argument, value):
    """What is wrong with the answer of a call to a hostile value; None if nothing is."""
    call = CALLS[name]
    arguments = call.arguments()
    arguments[argument] = value
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            result = call.of(**arguments)
    except (FieldError, FieldTypeError, *FAILED) as error:
        text = str(error)
        if "\n" in text:
            return f"an error of several lines: {text}"
        words = (argument, *call.named.get(argument, ()))
        if not isinstance(error, FAILED) and not any(word in text for word in words):
            return f"an error that names no {argument}: {text}"
    except Exception as error:  # what must not come
        return f"{type(error).__name__}: {str(error)[:200]}"
    else:
        for way, found in numbers(result):
            if found.device.type == "meta":
                return f"{way} is on no device"
            if found.is_floating_point() and not found.isfinite().all():
                single = "stderr" in way and not found.isnan().any()
                if not (single or (call.infinite and not found.isnan().any())):
                    return f"{way} is not finite"
    return None


@pytest.mark.parametrize("name", CALLS)
def test_every_value_as_every_argument(name):
    found = {
        f"{argument} = {label}": bad
        for argument in CALLS[name].arguments()
        for label, value in VALUES.items()
        if (bad := verdict(name, argument, value))
    }
    assert not found


def test_the_cases_are_many():
    assert sum(len(call.arguments()) for call in CALLS.values()) * len(VALUES) > 15_000


DTYPES = st.sampled_from([torch.float64, torch.float32, torch.float16, torch.int64, torch.bool, torch.complex64])
FLOATS = st.floats() | st.sampled_from([0.0, -0.0, 5e-324, 1e-300, 1e300, -1e300, math.nan, math.inf])
ARRAYS = st.builds(
    lambda shape, dtype, value, last: torch.cat(
        [torch.full(shape, value, dtype=torch.float64), torch.full((*shape[:-1], 1), last, dtype=torch.float64)], -1
    ).to(dtype),
    st.lists(st.integers(0, 5), min_size=1, max_size=4),
    DTYPES,
    FLOATS,
    FLOATS,
)
ANYTHING = st.recursive(
    FLOATS | st.integers() | st.booleans() | st.none() | st.text(max_size=5) | st.binary(max_size=5) | st.complex_numbers(),
    lambda inner: st.lists(inner, max_size=5) | st.tuples(inner, inner) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=6,
)  # fmt: skip
PLACES = [(name, argument) for name, call in CALLS.items() for argument in call.given_names()]


@settings(max_examples=800)
@given(st.sampled_from(PLACES), ANYTHING | ARRAYS)
def test_anything_as_any_argument(place, value):
    assert verdict(*place, value) is None


@settings(max_examples=200)
@given(st.sampled_from(sorted(CALLS)), st.text(min_size=1, max_size=8))
def test_arguments_that_are_not_there_and_some_too_many(name, word):
    """Python's own TypeError for a missing argument or one of an unknown name; a typed error that names an option."""
    arguments = CALLS[name].arguments()
    if word not in arguments:
        with pytest.raises((TypeError, FieldError)) as caught:
            CALLS[name].of(**arguments, **{word: 1})
        assert word in str(caught.value) or repr(word)[1:-1] in str(caught.value)


# Extremes that have an answer have the right one


SIZES = [1e-300, 1e-150, 1.0, 1e150, 1e300]


@pytest.mark.parametrize("size", SIZES)
def test_centers_do_not_depend_on_the_unit_of_energy(size):
    expected = tc.energy_center(ENERGY)
    torch.testing.assert_close(tc.energy_center(size * ENERGY), expected, rtol=1e-13, atol=0)


@pytest.mark.parametrize("size", SIZES)
def test_predictions_are_linear_in_the_start(size):
    for solved in (master().solve, master().standard_error, rates_alone().dissipated):
        expected = solved(START, TIMES)
        torch.testing.assert_close(solved(size * START, TIMES) / size, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("size", [1e-200, 1e-100, 1e100, 1e200])
def test_frequencies_scale_with_the_masses(size):
    expected = tc.normal_modes(chain()).frequencies
    found = tc.normal_modes(tc.Chain(size * chain().masses)).frequencies
    torch.testing.assert_close(found * size**0.5, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("time", [5e-324, 1e-300, 1e-20])
def test_at_once_nothing_has_moved(time):
    still = tc.evolve(chain(), state(), [time]).displacement[..., 0, :]
    torch.testing.assert_close(still, state().displacement, rtol=0, atol=1e-16)
    torch.testing.assert_close(master().solve(START, [time])[0], START, rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [1e-60, 1e-30, 1e30, 1e60])
def test_shares_of_the_energy_do_not_depend_on_the_amplitude(size):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        wave = tc.evolve(chain(), tc.standing_wave(chain(), 1, size), TIMES)
    expected = tc.band_energy(chain(), trajectory(), 2)
    torch.testing.assert_close(tc.band_energy(chain(), wave, 2), expected, rtol=1e-11, atol=1e-13)


# What takes too much memory is refused before it is taken


HUGE = [
    (lambda: tc.simulate(tc.Scene(n_particles=10**6, n_bands=1, realizations=1), "modes"), "n_particles"),
    (lambda: tc.simulate(tc.Scene(n_particles=10**8, times=np.arange(10**4), observables=["energy"], excitation=tc.Impulse())), "observables"),
    (lambda: tc.band_transfer(tc.Scene(n_particles=10**6, n_bands=50_000, realizations=1, times=np.arange(100)), "chebyshev", long_time=False), "n_particles"),
    (lambda: tc.Disorder().masses(10**8, 10**6, 0), "realizations"),
    (lambda: tc.Disorder().stiffnesses(10**8, range(10**5), 0), "realizations"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "field"), HUGE)
def test_what_cannot_fit_is_refused_with_the_estimate(call, field):
    with (
        Taken() as taken,
        pytest.raises(
            FieldError, match=rf"{field} must (need|take) at most the .* GB of memory .*: about .* GB"
        ) as caught,
    ):
        call()
    assert "\n" not in str(caught.value)
    assert taken.largest < LITTLE


def test_what_is_taken_is_counted():
    with Taken() as by_torch:
        torch.zeros(10**7)
    with Taken() as by_numpy:
        np.zeros(10**7)
    assert (by_torch.largest, by_numpy.largest // 10**7) == (4 * 10**7, 8)
