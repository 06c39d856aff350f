"""The plan: what it may choose, that it keeps to tolerances, and that its record of the machine is checked."""

import json
from dataclasses import replace

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.cli import main
from torchchain.ensemble import layout, predictions
from torchchain.ensemble import plan as planning
from torchchain.ensemble.moving_part import PartExceeded, moving_part
from torchchain.ensemble.plan import forecast
from torchchain.ensemble.scene_file import regular_times
from torchchain.evolvers import start
from torchchain.master.stand_in import plan


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
        ({"contact": "hertz"}, {"verlet", "symplectic4", "dopri8"}),
        ({"damping": 0.1}, {"damped", "verlet", "dopri8"}),
        ({"contact": "hertz", "damping": 0.1}, {"verlet", "dopri8"}),
    ],
)
def test_only_methods_that_can_treat_the_scene(fields, methods):
    found = plan(scene(**fields))
    assert {found.method, *(other.method for other in found.runners_up)} == methods


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("method", ["verlet", "symplectic4"])
def test_error_of_a_planned_step_is_within_the_tolerance(tolerance, method):
    """The step that the plan would give, against the exact modes: energies per particle relative to the largest."""
    wanted = scene(tolerance=tolerance)
    planned = plan(wanted)
    choices = {choice.method: choice for choice in planned.runners_up} | {planned.method: planned}
    chain = wanted.chain(range(4))
    start = wanted.state(chain)
    exact = tc.particle_energy(chain, tc.evolve(chain, start, wanted.times))
    found = tc.particle_energy(chain, tc.evolve(chain, start, wanted.times, method, **choices[method].options))
    assert float((found - exact).abs().max() / exact.abs().max()) <= tolerance


WHOLE = {"excitation": tc.StandingWave(tones=(7,)), "observables": ("energy",), "tolerance": 1e-8}


@pytest.mark.parametrize(
    ("fields", "method"),
    [
        ({"n_particles": 32, "times": torch.tensor([5e5]), "tolerance": 1e-6}, "tridiagonal"),
        ({"n_particles": 32, "times": torch.tensor([5e5]), "tolerance": 1e-6, "boundary": "periodic"}, "modes"),
        ({"n_particles": 100_000, "times": torch.arange(0.0, 100.0, 10.0), "tolerance": 1e-8}, "chebyshev"),
        ({"n_particles": 4096, "times": torch.arange(0.0, 500.0, 100.0), **WHOLE}, "chebyshev"),
        ({"n_particles": 512, "contact": "hertz", "tolerance": 1e-6}, "symplectic4"),
        ({"n_particles": 64, "damping": 0.1, "tolerance": 1e-9}, "damped"),
        ({"n_particles": 4096, "damping": 0.1, "tolerance": 1e-3, **{**WHOLE, "tolerance": 1e-3}}, "verlet"),
    ],
)
def test_clear_cut_scenes(fields, method):
    assert plan(scene(**fields)).method == method


def test_a_cold_kernel_is_not_compiled_for_a_small_job():
    assert plan(scene()).method in ("modes", "tridiagonal")


def test_float32_only_where_the_tolerance_allows_it():
    loose, tight = (plan(scene(n_particles=512, contact="hertz", tolerance=t)) for t in (1e-2, 1e-9))
    assert loose.dtype == torch.float32
    assert loose.run_options["dtype"] == "float32"
    assert tight.dtype == torch.float64
    assert "dtype" not in tight.run_options


def test_float32_as_chosen_keeps_to_the_tolerance():
    wanted = scene(
        n_particles=512,
        contact="hertz",
        tolerance=1e-2,
        observables=("energy",),
        excitation=tc.Impulse(site=200, velocity=0.3),
    )
    chosen = plan(wanted)
    assert chosen.dtype == torch.float32
    found = tc.simulate(wanted, chosen.method, options=chosen.run_options).energy
    exact = tc.simulate(wanted, "verlet", options={"step": 0.004}).energy
    assert float(abs(found - exact).max() / abs(exact).max()) <= 1e-2


RING = {"boundary": "periodic", "excitation": tc.StandingWave(), "observables": ("band_energy",), "n_bands": 8}


def test_theory_is_offered_where_its_error_meets_the_tolerance():
    many = scene(**RING, realizations=400, disorder=tc.Disorder(strength=0.05), tolerance=0.02)
    planned = plan(many)
    choice = next(choice for choice in planned.choices if choice.method == "theory")
    assert choice.predicted_error <= 0.02
    assert any("no chains needed" in reason for reason in planned.reasons)
    measured = tc.band_transfer(many)
    off = (tc.band_transfer(many, method="theory").mean - measured.mean).abs()
    assert float((off - 5 * measured.stderr).max()) <= choice.predicted_error
    strict = plan(scene(**RING, realizations=400, disorder=tc.Disorder(strength=0.05), tolerance=1e-5))
    assert all(choice.method != "theory" for choice in strict.choices)


def test_theory_takes_the_place_of_very_many_chains():
    planned = plan(
        scene(**RING, n_particles=256, realizations=10**5, disorder=tc.Disorder(strength=0.05), tolerance=0.02)
    )
    assert planned.method == "theory"


@pytest.mark.parametrize(
    "fields",
    [{"boundary": "fixed"}, {"observables": ("band_energy", "energy")}, {"disorder": tc.Disorder(strength=0.0)}],
)
def test_theory_is_not_offered_for_what_it_does_not_give(fields):
    planned = plan(scene(**RING | fields, tolerance=0.5))
    assert all(choice.method != "theory" for choice in planned.choices)


STIFF = [tc.Disorder("gamma", 1.0), tc.Disorder("lognormal", 0.9)]
VARIED = [
    {"excitation": tc.Impulse(site=32), "observables": ("energy",), "boundary": "periodic"},
    {"excitation": tc.StandingWave(tones=(5, 20)), "observables": ("displacement",)},
    {"excitation": tc.StandingWave(tones=(3,)), "observables": ("band_energy",), "n_bands": 8, "boundary": "periodic"},
    {"excitation": tc.Impulse(site=3), "observables": ("width",), "disorder": tc.Disorder(strength=0.5)},
]


@pytest.mark.parametrize("fields", VARIED)
@pytest.mark.parametrize("tolerance", [1e-3, 1e-7])
def test_predicted_errors_are_bounds(fields, tolerance):
    """Every way that the plan lists, against another exact one."""
    wanted = scene(**fields, tolerance=tolerance)
    for choice in plan(wanted).choices:
        options = {**choice.options, **({"dtype": "float32"} if choice.dtype == torch.float32 else {})}
        if not choice.good or options.get("step", 1.0) < 1e-3 or choice.method == "theory":  # of an endless ensemble
            continue
        found = tc.simulate(wanted, choice.method, options=options)
        exact = tc.simulate(wanted, "chebyshev" if choice.method == "modes" else "modes")
        for name in wanted.observables:
            error = float(abs(found[name] - exact[name]).max() / abs(exact[name]).max())
            assert error <= choice.predicted_error, (choice, error)


@pytest.mark.parametrize("stiffness", [None, STIFF[1]])
@pytest.mark.parametrize("contact", ["linear", "hertz"])
@pytest.mark.parametrize(
    "excitation", [tc.StandingWave((11,), 2e-4), tc.StandingWave((17,), 2e-4), tc.Impulse(1, 2e-3)]
)
def test_swings_of_the_total_energy_keep_to_the_tolerance(excitation, contact, stiffness):
    """A composition's energy swings by more than its phases are off."""
    wanted = scene(
        n_particles=36, excitation=excitation, times=regular_times(0.0, 100.0, 3.0), tolerance=1e-3, contact=contact,
        disorder=tc.Disorder(strength=0.3), observables=("total_energy",), boundary="periodic", energy_definition="bond",
        stiffness_disorder=stiffness,
    )  # fmt: skip
    for choice in plan(wanted).choices:
        if choice.method in ("verlet", "symplectic4") and choice.dtype == torch.float64:
            found = tc.simulate(replace(wanted, realizations=1), choice.method, options=choice.options).total_energy
            assert float(abs(found / found[..., 0] - 1).max()) <= choice.predicted_error <= 1e-3


def test_without_a_tolerance_the_ensemble_sets_it():
    few, many = (plan(scene(realizations=r)) for r in (4, 400))
    assert few.tolerance == pytest.approx(10 * many.tolerance)
    assert "ensemble's own error" in few.reasons[0]


def test_without_a_tolerance_the_method_adds_little_to_the_error_of_the_ensemble():
    wanted = scene(realizations=40, observables=("energy",), excitation=tc.Impulse(site=32))
    planned = plan(wanted)
    assert planned.predicted_error <= planned.tolerance
    exact = tc.simulate(wanted, "modes")
    found = tc.simulate(wanted)
    statistical = float((exact.energy_stderr / exact.energy.max()).max())
    assert float(abs(found.energy - exact.energy).max() / exact.energy.max()) <= statistical / 3
    assert planned.tolerance <= statistical  # of the noisiest particle and time


def test_impossible_tolerance_is_refused_with_the_reachable_one():
    with pytest.raises(FieldError, match=r"tolerance must be at least .* method"):
        plan(scene(tolerance=1e-15))


def test_auto_gives_what_the_plan_names():
    wanted = scene(realizations=3)
    tc.simulate(wanted, "chebyshev")  # loads the kernels, which the plan counts
    named = plan(wanted)
    torch.testing.assert_close(
        torch.from_numpy(tc.simulate(wanted).center.values),
        torch.from_numpy(tc.simulate(wanted, named.method, options=named.run_options).center.values),
        rtol=0,
        atol=0,
    )


def test_plan_prints_its_reasons_and_runners_up():
    text = str(plan(scene()))
    for word in ("method", "tolerance", "error", "time", "because", "runner-up"):
        assert word in text


@pytest.mark.parametrize(("velocity", "law"), [(0.001, "linear"), (0.3, "hertz")])
def test_contact_law_follows_the_amplitude(velocity, law):
    wanted = scene(
        contact="auto", tolerance=1e-2, excitation=tc.Impulse(site=20, velocity=velocity), observables=("energy",)
    )
    planned = plan(wanted)
    assert planned.scene.contact == planning.resolved(wanted).contact == law
    assert law in planned.reasons[1].lower()
    if law == "linear":  # the contact that was left out would have made no more difference than was allowed
        found, hertz = (tc.simulate(replace(wanted, contact=c, energy_definition="bond")) for c in ("auto", "hertz"))
        assert float(abs(found.energy - hertz.energy).max() / hertz.energy.max()) < 1e-2
    else:
        assert 'contact = "hertz"' in tc.simulate(wanted).attrs["scene"]


def test_contact_and_method_share_the_tolerance():
    """What linear contacts leave out counts into the predicted error, and the method has the rest of the tolerance."""
    wave = {"excitation": tc.StandingWave((8,), 0.002), "observables": ("energy",), "energy_definition": "bond"}
    alone = plan(scene(**wave, tolerance=1e-2))
    off = predictions.Facts(alone.scene).accumulated
    assert plan(scene(**wave, contact="auto", tolerance=off / 0.99)).scene.contact == "hertz"
    planned = plan(scene(**wave, contact="auto", tolerance=off / 0.85))
    assert planned.scene.contact == "linear"
    assert off < planned.predicted_error <= planned.tolerance
    step = {choice.method: choice.options["step"] for choice in planned.choices if "step" in choice.options}
    free = {
        choice.method: choice.options["step"]
        for choice in plan(scene(**wave, tolerance=off / 0.85)).choices
        if "step" in choice.options
    }
    assert all(step[name] < free[name] for name in step)


def test_hardly_any_disorder_asks_for_no_more_than_chains_all_the_same():
    wanted = [scene(disorder=tc.Disorder(strength=xi), observables=("energy",)) for xi in (0.0, 1e-300)]
    first, second = map(plan, wanted)
    assert first.tolerance == second.tolerance > second.predicted_error


@pytest.mark.parametrize(
    "fields",
    [
        {"n_particles": 16, "excitation": tc.StandingWave((7,), 0.2), "times": [0.18, 0.64, 1.25], "tolerance": 4e-5},
        {"n_particles": 12, "excitation": tc.Impulse(5, 0.3), "times": [0.46, 0.84, 1.37], "tolerance": 3e-4},
        {"n_particles": 8, "excitation": tc.StandingWave((2,), 0.05), "times": [0.2, 0.75, 2.07], "tolerance": 1.4e-7},
    ],
)
def test_the_first_steps_keep_to_the_tolerance_too(fields):
    # Energies swing with the first step, when phases are hardly off.
    disorder = tc.Disorder("binary", 0.05)
    wanted = tc.Scene(**fields, contact="hertz", disorder=disorder, realizations=3, observables=("total_energy", "energy"))
    found, exact = tc.simulate(wanted), tc.simulate(wanted, "dopri8", options={"rtol": 1e-11, "atol": 1e-15})
    for name in wanted.observables:
        assert float(abs(found[name] - exact[name]).max()) <= wanted.tolerance * float(exact[name].max())


def test_hertz_by_amplitude_has_no_bands():
    waves = tc.StandingWave(amplitude=0.5)
    wanted = scene(contact="auto", tolerance=1e-6, excitation=waves, observables=("band_energy",), n_bands=4)
    with pytest.raises(FieldError, match=r"contact must be 'linear' for the observable band_energy"):
        tc.simulate(wanted)
    with pytest.raises(FieldError, match=r"got 'auto' and elongation about .* of the overlap, .*, 1.0e-06 allowed"):
        tc.plan(wanted)


@pytest.mark.parametrize("boundary", ["fixed", "periodic"])
@pytest.mark.parametrize("contact", ["linear", "hertz"])
def test_the_part_that_a_wave_reaches_gives_what_the_whole_chain_does(boundary, contact, monkeypatch):
    every = ("center", "width", "energy", "displacement", "source_energy", "total_energy")
    wanted = scene(
        n_particles=400, boundary=boundary, contact=contact, observables=every, times=torch.arange(0.0, 31.0, 5.0),
        excitation=tc.Impulse(site=230, velocity=0.2),
    )  # fmt: skip
    part = moving_part(wanted)
    assert part is not None
    assert part.size < 200
    cut = tc.simulate(wanted, "symplectic4", options={"step": 0.2})
    monkeypatch.setattr(layout, "moving_part", lambda scene, method: None)
    whole = tc.simulate(wanted, "symplectic4", options={"step": 0.2})
    for name in every:
        scale = float(abs(whole[name]).max())
        assert float(abs(cut[name] - whole[name]).max()) <= 1e-13 * scale, name
    assert cut.attrs["mass_mean"] == whole.attrs["mass_mean"]


def test_a_wave_that_leaves_its_part_is_computed_on_the_whole_chain(monkeypatch):
    wanted = scene(n_particles=400, times=torch.tensor([30.0]), excitation=tc.Impulse(site=200))
    part = moving_part(wanted)
    short = replace(part, first=190, last=211)
    chain = short.chain(wanted.chain([0]))
    with pytest.raises(PartExceeded):
        short.check(chain, tc.evolve(chain, short.state(wanted.state(wanted.chain([0]))), [30.0]))
    expected = tc.simulate(wanted, "modes")
    monkeypatch.setattr(layout, "moving_part", lambda scene, method: short)
    found = tc.simulate(wanted, "modes")
    assert float(found.center[0]) == pytest.approx(float(expected.center[0]), rel=1e-12)


def test_bands_rings_struck_at_the_seam_and_late_times_need_the_whole_chain():
    fields = {"n_particles": 400, "times": torch.tensor([30.0]), "excitation": tc.Impulse(site=200)}
    assert moving_part(scene(**fields)) is not None
    assert moving_part(scene(**{**fields, "excitation": tc.Impulse(site=1), "boundary": "periodic"})) is None
    assert moving_part(scene(**{**fields, "times": torch.tensor([1000.0])})) is None
    assert moving_part(scene(**{**fields, "observables": ("wavenumber_energy",)})) is None


@pytest.fixture(scope="module")
def master():
    transfer = tc.band_transfer(transfer_scene())
    return tc.calibrate(transfer)


def transfer_scene(**fields):
    given = {"n_particles": 32, "n_bands": 4, "times": regular_times(0.0, 40.0, 0.5), "realizations": 40}
    return tc.Scene(**{**given, **fields})


@pytest.mark.filterwarnings("ignore::torchchain.master.equation.PredictionWarning")
def test_a_calibrated_model_takes_the_place_of_the_chains_where_it_covers_the_scene(master, tmp_path):
    wanted = transfer_scene(tolerance=0.2, times=regular_times(0.0, 40.0, 0.01), realizations=1000)
    planned = plan(wanted, artifact=master)
    assert planned.method == planning.ARTIFACT
    exact = tc.band_transfer(replace(wanted, times=regular_times(0.0, 40.0, 1.0)), "modes", long_time=False)
    found = master.solve(torch.eye(4, dtype=torch.float64), exact.times).detach()
    assert float((found - exact.mean).abs().max()) <= 0.2
    file = tmp_path / "q.safetensors"
    master.save(file)
    again = plan(wanted, artifact=file)
    assert again.method == planning.ARTIFACT
    assert again.predicted_error == pytest.approx(planned.predicted_error)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"disorder": tc.Disorder(strength=0.1)}, "disorder 0.1"),
        ({"boundary": "fixed"}, "boundary fixed"),
        ({"n_bands": 8}, "bands 8"),
        ({"observables": ("energy",)}, "energy, where it predicts energies of bands"),
        ({"excitation": tc.Impulse()}, "an impulse"),
        ({"tolerance": 1e-6}, "not accurate enough"),
    ],
)
def test_a_calibrated_model_that_does_not_fit_is_named_and_left(master, fields, words):
    plain = tc.MasterEquation(master.model, master.calibration, master.uncertainty)  # without the starts it measured
    planned = plan(transfer_scene(**fields), artifact=plain)
    assert planned.method != planning.ARTIFACT
    assert any(words in reason for reason in planned.reasons)


def test_command_plan_takes_a_model_file(master, tmp_path, capsys):
    file = tmp_path / "q.safetensors"
    master.save(file)
    flags = ["--n-particles", "32", "--n-bands", "4", "--tolerance", "0.2", "--times.stop", "40"]
    assert main(["plan", *flags, "--artifact", str(file)]) == 0
    assert "the master equation at hand covers the scene" in capsys.readouterr().out
    assert main(["plan", *flags, "--artifact", str(tmp_path / "none.safetensors")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "readable" in error


def test_a_run_reports_what_was_predicted_beside_what_was_measured(tmp_path, capsys):
    flags = [
        "--n-particles",
        "32",
        "--n-bands",
        "4",
        "--realizations",
        "3",
        "--times.stop",
        "5",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(["simulate", *flags]) == 0
    record = json.loads((tmp_path / "run" / "run.json").read_text())["forecast"]
    assert set(record) == {"predicted_seconds", "seconds", "predicted_error", "statistical_error"}
    assert min(record.values()) > 0
    assert "s predicted" in capsys.readouterr().out
    how = {"method": "rk4", "method_options": "{}"}
    assert set(forecast(scene(), how, 1.0, 0.1)) == {"seconds", "statistical_error"}


def test_chains_too_long_for_the_memory_of_a_method_leave_it_out():
    wanted = scene(
        n_particles=300_000, excitation=tc.StandingWave(tones=(100_000,)), times=torch.tensor([10.0]), tolerance=1e-6
    )
    planned = plan(wanted)
    assert planned.method == "chebyshev"
    assert not {"modes", "tridiagonal"} & {other.method for other in planned.runners_up}


@pytest.mark.parametrize("stiffness", STIFF)
def test_planned_steps_are_stable_for_the_stiffest_of_many_chains(stiffness):
    """The step that is handed to a method is refused beyond the stability limit of any chain."""
    wanted = scene(
        contact="hertz", stiffness_disorder=stiffness, realizations=400, tolerance=0.5, times=torch.tensor([20.0]),
        excitation=tc.Impulse(20, 0.05),
    )  # fmt: skip
    chain = wanted.chain(range(400))
    state = wanted.state(chain)
    steps = [choice for choice in plan(wanted).choices if "step" in choice.options]
    assert {choice.method for choice in steps} == {"verlet", "symplectic4"}
    for choice in steps:
        start(chain, state, choice.method, **choice.options)


def test_limits_of_chains_that_were_not_drawn(monkeypatch):
    """What the tail of some chains tells of the stiffest of more."""
    wanted = scene(contact="hertz", stiffness_disorder=STIFF[0], realizations=1000, excitation=tc.Impulse(20, 0.05))
    monkeypatch.setattr(predictions, "SAMPLE", 20 * 64)
    limit = predictions.Facts(wanted).limit
    highest = float(wanted.chain(range(1000)).squared_frequency_bound().sqrt().max())
    assert highest < limit / 0.7  # the part of the limit that steps are planned for
    assert limit < 3 * highest


@pytest.mark.parametrize("stiffness", STIFF)
@pytest.mark.parametrize("fields", [{"contact": "hertz"}, {"damping": 0.05}])
def test_steps_in_stiff_chains_keep_to_the_tolerance(stiffness, fields):
    wanted = scene(
        stiffness_disorder=stiffness, realizations=10, tolerance=1e-3, observables=("energy",), energy_definition="bond",
        excitation=tc.StandingWave((8, 25), 0.02), **fields,
    )  # fmt: skip
    exact = tc.simulate(wanted, "symplectic4", options={"step": 0.01}) if "contact" in fields else None
    exact = tc.simulate(wanted, "damped") if exact is None else exact
    for choice in plan(wanted).choices:
        if "step" in choice.options and choice.good and choice.dtype == torch.float64:
            found = tc.simulate(wanted, choice.method, options=choice.options)
            assert float(abs(found.energy - exact.energy).max() / exact.energy.max()) <= choice.predicted_error


AMPLITUDES = [
    (tc.StandingWave((8,), 0.04), 200.0, 0.3),
    (tc.StandingWave((2,), 0.004), 400.0, 0.1),
    (tc.Impulse(32, 0.02), 80.0, 0.3),
    (tc.Impulse(1, 0.02), 80.0, 0.0),
]


@pytest.mark.parametrize(("excitation", "end", "xi"), AMPLITUDES)
def test_nonlinearity_accumulates(excitation, end, xi):
    """What linear contacts do to energies by the last time is within what the plan expects of them."""
    disorder, times = tc.Disorder(strength=xi), regular_times(0.0, end, end / 10)
    wanted = scene(
        excitation=excitation, disorder=disorder, times=times, observables=("energy",), energy_definition="bond"
    )
    linear, hertz = (
        tc.simulate(replace(wanted, contact=law), "symplectic4", options={"step": 0.1}).energy
        for law in ("linear", "hertz")
    )
    off = float(abs(linear - hertz).max() / hertz.max())
    assert off <= predictions.Facts(wanted).accumulated
    chosen = planning.resolved(replace(wanted, contact="auto", tolerance=min(0.9, off * 0.99))).contact
    assert chosen == "hertz"


def test_the_choice_is_the_same_on_any_machine(monkeypatch):
    wanted = scene(n_particles=512, realizations=50)
    first = plan(wanted)
    monkeypatch.setattr(planning, "speed", lambda: 50.0)
    second = plan(wanted)
    assert (first.method, first.options, first.cost) == (second.method, second.options, second.cost)
    assert second.predicted_seconds > 1.5 * first.predicted_seconds


def test_plans_print_in_few_lines():
    found = plan(scene(tolerance=1e-3))
    assert 6 <= len(str(found).splitlines()) <= 14
    assert "<table>" in found._repr_html_()
