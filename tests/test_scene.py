import copy
import pickle
from dataclasses import replace

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.ensemble.scene_file import read_toml, regular_times
from torchchain.ensemble.scene_words import describe


def test_the_defaults_are_the_papers_case():
    scene = tc.Scene()
    assert (scene.n_particles, scene.boundary, scene.n_bands, scene.realizations) == (256, "periodic", 32, 100)
    assert scene.disorder == tc.Disorder("normal", 0.3, 0.05)
    assert scene.tones == tuple(range(2, 127, 4))
    assert torch.equal(scene.times, torch.arange(201, dtype=torch.float64) / 4)


def test_regular_times():
    assert regular_times(0, 1, 0.1).tolist() == pytest.approx([i / 10 for i in range(11)], rel=1e-15)
    assert regular_times(2, 2, 5).tolist() == [2]
    assert regular_times(1, 2, 0.4).tolist() == pytest.approx([1, 1.4, 1.8])
    for count in (3, 7, 49, 1000, 12345):  # stop is reached for whatever step
        assert len(regular_times(0.0, 1.0, 1 / count)) == count + 1
    assert regular_times(0, 5000, 0.1)[-1] == pytest.approx(5000, rel=1e-15)


SCENES = [
    tc.Scene(),
    tc.Scene(n_particles=64, n_bands=4, times=[0.0, 0.1, 0.7], seed=2**64 - 1, tolerance=1e-3),
    tc.Scene(n_particles=9, n_bands=7, boundary="fixed", excitation=tc.Impulse(3, -1e-3), observables=("energy",)),
    tc.Scene(
        n_particles=16, n_bands=2, excitation=tc.StandingWave((1, 8), 0.1, "cos"), observables=["band_energy", "width"]
    ),
    tc.Scene(stiffness_disorder=tc.Disorder("gamma", 0.1, 0.0), disorder=tc.Disorder(strength=0), n_bands=8),
    tc.Scene(contact="hertz", excitation=tc.Impulse(), observables=("total_energy",), damping=0.1, times=[5]),
    tc.Scene(energy_definition="bond", times=regular_times(3, 40, 0.3), n_bands=16),
]


@pytest.mark.parametrize("scene", SCENES, ids=range(len(SCENES)))
def test_scene_files_are_read_back_exactly(scene, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(scene.to_toml())
    again = tc.Scene.from_toml(path)
    assert torch.equal(again.times, scene.times)
    assert again.to_dict() == scene.to_dict()
    assert again.to_toml() == scene.to_toml()
    assert (again.disorder, again.excitation, again.stiffness_disorder) == (
        scene.disorder,
        scene.excitation,
        scene.stiffness_disorder,
    )


def test_irregular_times_are_kept_to_the_last_bit(tmp_path):
    times = torch.cumsum(torch.rand(30, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), 0)
    path = tmp_path / "scene.toml"
    path.write_text(tc.Scene(times=times).to_toml())
    assert torch.equal(tc.Scene.from_toml(path).times, times)


def test_a_partial_file_leaves_the_defaults(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("n_particles = 128\n[disorder]\nstrength = 0.1\n[times]\nstop = 2\nstep = 1\n")
    scene = tc.Scene.from_toml(path)
    assert (scene.n_particles, scene.disorder.strength, scene.disorder.lower, scene.n_bands) == (128, 0.1, 0.05, 32)
    assert scene.times.tolist() == [0, 1, 2]


def test_chains_are_those_of_the_disorder():
    scene = tc.Scene(n_particles=12, n_bands=2, boundary="fixed", stiffness_disorder=tc.Disorder("gamma", 0.2), seed=4)
    chain = scene.chain([3, 1])
    assert torch.equal(chain.masses, scene.disorder.masses(12, [3, 1], 4))
    assert torch.equal(chain.contact_stiffness, tc.Disorder("gamma", 0.2).stiffnesses(13, [3, 1], 4))
    assert scene.chain(range(2), dtype=torch.float32).masses.dtype == torch.float32
    assert scene.state(chain).displacement.shape == (2, 2, 12)
    kick = tc.Scene(n_particles=12, excitation=tc.Impulse(5), observables=("energy",))
    assert kick.state(chain).velocity[:, 4].tolist() == [0.01, 0.01]
    assert kick.tones == ()


def test_ordered():
    none = tc.Disorder(strength=0.0)
    assert tc.Scene(disorder=none).is_ordered
    assert tc.Scene(disorder=none, stiffness_disorder=none).is_ordered
    assert not tc.Scene(disorder=none, stiffness_disorder=tc.Disorder(strength=0.1)).is_ordered
    assert not tc.Scene().is_ordered


def test_bands_matter_only_where_asked_for():
    assert not tc.Scene(n_particles=9, excitation=tc.Impulse(), observables=("energy",)).needs_bands
    assert not tc.Scene(n_particles=9, excitation=tc.StandingWave((1,)), observables=("energy",)).needs_bands
    assert tc.Scene(n_particles=64, n_bands=4, observables=("energy",)).needs_bands  # the tones are the bands' centers


def test_description():
    assert describe(tc.Scene()) == "100 periodic chains, N = 256, xi = 0.3, 32 standing waves, 201 times to 50"
    kick = tc.Scene(n_particles=9, boundary="fixed", excitation=tc.Impulse(3), observables=("energy",), times=[1e3])
    assert describe(kick) == "100 fixed chains, N = 9, xi = 0.3, impulse at particle 3, 1 times to 1000"


NAN, INF = float("nan"), float("inf")
VALUE, TYPE = FieldError, FieldTypeError


@pytest.mark.parametrize(
    ("fields", "error", "message"),
    [
        ({"n_particles": 1}, VALUE, "n_particles must be at least 2, got 1"),
        ({"n_particles": 10**9}, VALUE, "n_particles must be at most 100000000"),
        ({"n_particles": 2.0}, TYPE, "n_particles must be an integer, got 2.0"),
        ({"n_particles": True}, TYPE, "n_particles must be an integer, got True"),
        ({"n_particles": 255}, VALUE, "n_particles must be even for wavenumber bands, got 255"),
        ({"boundary": "open"}, VALUE, "boundary must be one of periodic, fixed, got 'open'"),
        ({"disorder": None}, TYPE, r"disorder must be a Disorder, e.g. tc.Disorder\(strength=0.3\), got None"),
        ({"excitation": "impulse"}, TYPE, "excitation must be an Impulse or a StandingWave"),
        ({"stiffness_disorder": 0.3}, TYPE, "stiffness_disorder must be a Disorder"),
        ({"times": None}, TYPE, "times must be real numbers, got None"),
        ({"times": "now"}, TYPE, "times must be real numbers"),
        ({"times": [True]}, TYPE, "times must be real numbers"),
        ({"times": [1j]}, TYPE, "times must be real numbers"),
        ({"times": 3.0}, VALUE, r"times must be one-dimensional, got shape \(\)"),
        ({"times": [[1.0]]}, VALUE, "times must be one-dimensional"),
        ({"times": []}, VALUE, "times must hold at least one time"),
        ({"times": [0, 1, 1]}, VALUE, "times must increase strictly, got 1 then 1 at position 3"),
        ({"times": [2, 1]}, VALUE, "times must increase strictly, got 2 then 1 at position 2"),
        ({"times": [-1, 1]}, VALUE, "times must not be negative, got -1 at position 1"),
        ({"times": [0, NAN]}, VALUE, "times must be finite, got nan at position 2"),
        ({"times": [INF]}, VALUE, "times must be finite, got inf"),
        ({"times": [10**400]}, VALUE, "times must be finite"),
        ({"times": [1e300]}, VALUE, r"times must be at most 1e\+12"),
        ({"n_bands": 0}, VALUE, "n_bands must be at least 1"),
        ({"n_bands": 127}, VALUE, "n_bands must divide the number of tones n_particles/2 = 128, got 127"),
        ({"n_bands": 256}, VALUE, "n_bands must be at most the number of tones"),
        ({"n_bands": 128}, VALUE, "excitation.tones must be less than n_particles/2 = 128 for phase 'sin'"),
        ({"excitation": tc.StandingWave((128,))}, VALUE, "excitation.tones must be less than n_particles/2 = 128"),
        ({"excitation": tc.StandingWave((129,), phase="cos")}, VALUE, "excitation.tones must be at most 128"),
        ({"excitation": tc.Impulse(257)}, VALUE, "excitation.site must be at most 256, got 257"),
        ({"realizations": 0}, VALUE, "realizations must be at least 1"),
        ({"realizations": 10**10}, VALUE, "realizations must be at most 1000000000"),
        ({"seed": -1}, VALUE, "seed must be at least 0"),
        ({"seed": 2**64}, VALUE, "seed must be at most 18446744073709551615"),
        ({"seed": 0.0}, TYPE, "seed must be an integer"),
        ({"tolerance": 0}, VALUE, "tolerance must be greater than 0"),
        ({"tolerance": 1}, VALUE, "tolerance must be less than 1"),
        ({"tolerance": NAN}, VALUE, "tolerance must be finite"),
        ({"observables": "energy"}, TYPE, "observables must be a list of names, got 'energy'"),
        ({"observables": ()}, TYPE, "observables must be a list of names"),
        ({"observables": None}, TYPE, "observables must be a list of names"),
        ({"observables": (1,)}, TYPE, "observables must be a string, one of"),
        ({"observables": ("enrgy",)}, VALUE, "observables must be one of band_energy, .*, got 'enrgy'"),
        ({"observables": ("width", "width")}, VALUE, "observables must be different, got .*width"),
        ({"contact": "glue"}, VALUE, "contact must be one of linear, hertz"),
        ({"contact": "hertz"}, VALUE, "contact must be 'linear' for the observable band_energy"),
        ({"contact": "hertz", "observables": ["wavenumber_energy"]}, VALUE, "for the observable wavenumber_energy"),
        ({"damping": -1}, VALUE, "damping must be at least 0"),
        ({"damping": INF}, VALUE, "damping must be finite"),
        ({"damping": 1, "observables": ["long_time_band_energy"]}, VALUE, "damping must be zero for the observable"),
        ({"energy_definition": "both"}, VALUE, "energy_definition must be one of site, bond"),
        ({"energy_definition": "bond", "boundary": "fixed"}, VALUE, "boundary must be 'periodic' for the observable"),
        ({"si": 3}, TYPE, "si must be a Scaling"),
    ],
)
def test_bad_fields(fields, error, message):
    with pytest.raises(error, match=message) as caught:
        tc.Scene(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("n_partcles = 4", "scene must have only the keys n_particles, .*, got 'n_partcles'"),
        ("disorder = 3", "disorder must be a table, got 3"),
        ("[disorder]\nxi = 0.3", "disorder must have only the keys kind, strength, lower, got 'xi'"),
        ("[disorder]\nstrength = nan", "disorder.strength must be finite"),
        ("[stiffness_disorder]\nkind = 'x'", "^stiffness_disorder.kind must be one of"),
        ("[excitation]\nkind = 'kick'", "excitation.kind must be one of impulse, standing_wave, got 'kick'"),
        ("[excitation]\nkind = 3", "excitation.kind must be a string"),
        (
            "[excitation]\nkind = 'impulse'\ntones = [1]",
            "excitation.kind must be 'standing_wave' for excitation.tones, got 'impulse'",
        ),
        ("[excitation]\ntones = 'all'", "excitation.tones must be a list of integers"),
        ("[excitation]\ntones = [true]", "excitation.tones must be an integer, got True"),
        ("times = 3", "times must be one-dimensional"),
        ("times = [true, false]", "times must be real numbers"),
        ("times = [2020-01-01]", "times must be real numbers"),
        ("times = [1" + "0" * 400 + "]", "times must be finite"),
        ("[times]\nstop = 3", "times must have step"),
        ("[times]\nstep = 3", "times must have stop"),
        ("[times]\nstop = 1\nstep = 0", "times.step must be greater than 0"),
        ("[times]\nstop = 1\nstep = 1e-300", "times.step must give fewer than 10000000 times, got 1e-300"),
        ("[times]\nstop = 'x'\nstep = 1", "times.stop must be a number"),
        ("[times]\nstop = 1\nstep = 1\nend = 3", "times must have only the keys start, stop, step, got 'end'"),
        ("observables = 'energy'", "observables must be a list of names"),
        ("observables = {energy = 1}", "observables must be a list of names"),
        ("[[disorder]]\nstrength = 1", "disorder must be a table"),
        ("[scene]\nn_particles = 4", "scene must have only the keys"),
        ("n_particles = ", "config .* must be a TOML file, got Invalid value"),
        ("n_particles = 4\nn_particles = 4", "config .* must be a TOML file"),
        ("seed = 1" + "0" * 5000, "config .* must be a TOML file, got Exceeds the limit"),
        ("a = " + "[" * 100_000, "config .* must be a TOML file, got maximum recursion"),
    ],
)
def test_bad_files(text, message, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises((FieldError, FieldTypeError), match=message) as caught:
        tc.Scene.from_toml(path)
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(FieldError, match="config .*nothing.toml must be a readable file, got No such file"):
        read_toml(tmp_path / "nothing.toml")
    with pytest.raises(FieldError, match="must be a readable file, got Is a directory"):
        read_toml(tmp_path)
    path = tmp_path / "two\nlines.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(FieldError, match="must be a TOML file, got 'utf-8' codec") as caught:
        read_toml(path)
    assert "\n" not in str(caught.value)


def test_a_misspelled_field_names_the_one_meant():
    with pytest.raises(tc.FieldTypeError, match="a scene has no field 'n_particle'; did you mean n_particles?"):
        tc.Scene(n_particle=8)
    with pytest.raises(tc.FieldTypeError, match="a disorder has no field 'xi'; did you mean strength?"):
        tc.Disorder(xi=0.3)
    with pytest.raises(tc.FieldTypeError, match="an impulse has no field 'position'; did you mean site?"):
        tc.Impulse(position=3)
    scene = tc.Scene(n_particles=8, n_bands=2)
    assert copy.deepcopy(scene).to_dict() == pickle.loads(pickle.dumps(scene)).to_dict() == scene.to_dict()


def test_a_plan_is_ten_lines_at_most():
    scene = tc.Scene(
        n_particles=4096, boundary="fixed", excitation=tc.Impulse(), observables=("center",), times=[0.0, 20.0]
    )
    for each in (scene, replace(scene, contact="auto"), tc.Scene(damping=0.1), tc.Scene(tolerance=1e-4)):
        plan = tc.plan(each)
        assert 6 <= len(repr(plan).splitlines()) <= 10
        assert all(reason in repr(plan) for reason in plan.reasons)
