"""The plan: what it may choose, that it keeps to tolerances, and that its record of the machine is checked."""

import json

import pytest
import torch

import torchchain as tc
from torchchain import machine, planning
from torchchain.checks import FieldError
from torchchain.machine import Machine

TYPICAL = Machine(compilation=0.0)


def scene(**fields):
    given = {
        "n_particles": 64, "boundary": "fixed", "excitation": tc.Impulse(), "observables": ("center",),
        "times": torch.arange(0.0, 30.0, 1.0), "realizations": 4,
    }  # fmt: skip
    return tc.Scene(**{**given, **fields})


@pytest.mark.parametrize(
    ("fields", "methods"),
    [
        ({}, {"modes", "tridiagonal", "chebyshev", "verlet", "symplectic4"}),
        ({"boundary": "periodic"}, {"modes", "chebyshev", "verlet", "symplectic4"}),
        ({"contact": "hertz"}, {"verlet", "symplectic4"}),
        ({"damping": 0.1}, {"damped", "verlet"}),
    ],
)
def test_only_methods_that_can_treat_the_scene(fields, methods):
    found = planning.plan(scene(**fields), TYPICAL)
    assert {found.method, *(other.method for other in found.runners_up)} == methods


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("method", ["verlet", "symplectic4"])
def test_error_of_a_planned_step_is_within_the_tolerance(tolerance, method):
    """The step that the plan would give, against the exact modes: energies per particle relative to the largest."""
    wanted = scene(tolerance=tolerance)
    planned = planning.plan(wanted, TYPICAL)
    choices = {choice.method: choice for choice in planned.runners_up} | {planned.method: planned}
    chain = wanted.chain(range(4))
    start = wanted.state(chain)
    exact = tc.particle_energy(chain, tc.evolve(chain, start, wanted.times))
    found = tc.particle_energy(chain, tc.evolve(chain, start, wanted.times, method, **choices[method].options))
    assert float((found - exact).abs().max() / exact.abs().max()) <= tolerance


def test_long_chains_go_without_matrices_and_short_ones_at_late_times_with_modes():
    long = scene(n_particles=4096, times=torch.arange(0.0, 100.0, 10.0))
    assert planning.plan(long, TYPICAL).method == "chebyshev"
    late = scene(n_particles=32, times=torch.tensor([5e5]))
    assert planning.plan(late, TYPICAL).method in ("modes", "tridiagonal")


def test_a_cold_kernel_is_not_compiled_for_a_small_job():
    assert planning.plan(scene(), Machine()).method in ("modes", "tridiagonal")


def test_without_a_tolerance_the_ensemble_sets_it():
    few, many = (planning.plan(scene(realizations=r), TYPICAL) for r in (4, 400))
    assert few.tolerance == pytest.approx(10 * many.tolerance)
    assert "ensemble's own error" in few.reasons[0]


def test_impossible_tolerance_is_refused_with_the_reachable_one():
    with pytest.raises(FieldError, match=r"tolerance must be at least .* method"):
        planning.plan(scene(tolerance=1e-15), TYPICAL)


def test_auto_gives_what_the_plan_names():
    wanted = scene(realizations=3)
    named = planning.plan(wanted)
    torch.testing.assert_close(
        torch.from_numpy(tc.simulate(wanted).center.values),
        torch.from_numpy(tc.simulate(wanted, named.method, options=named.options).center.values),
        rtol=0,
        atol=0,
    )


@pytest.mark.parametrize("content", ["", "{", "[]", '{"flop": -1}', '{"version": 2, "flop": "fast"}', '{"bogus": 1}'])
def test_a_spoiled_machine_record_is_measured_again(tmp_path, monkeypatch, content):
    monkeypatch.setenv("TORCHCHAIN_CACHE", str(tmp_path))
    monkeypatch.setattr(machine, "measure", lambda: TYPICAL)
    (tmp_path / "machine.json").write_text(content)
    assert machine.this_machine() == TYPICAL
    assert Machine(**json.loads((tmp_path / "machine.json").read_text())) == TYPICAL


def test_plan_prints_its_reasons_and_runners_up():
    text = str(planning.plan(scene(), TYPICAL))
    for word in ("method", "tolerance", "error", "time", "because", "runner-up"):
        assert word in text
