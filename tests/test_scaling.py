import math
import warnings

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.chain.scaling import QUANTITIES
from torchchain.checks import FieldError, FieldTypeError

STEEL = {"radius": 5e-3, "density": 7800.0, "young_modulus": 210e9, "poisson_ratio": 0.3, "force": 10.0}
GLASS = {"radius": 1e-3, "density": 2500.0, "young_modulus": 70e9, "poisson_ratio": 0.2, "force": 0.1}
BALLISTIC = 32 / (15 * math.pi)


def test_steel_bead_by_hand():
    # Hertz: F = (4/3) E* sqrt(R*) delta^(3/2) with E* = E / (2 (1 - nu^2)) = 115.385 GPa and R* = a / 2 = 2.5 mm, so that
    # F = 7.69231e9 N / m^(3/2) delta^(3/2); 10 N make (1.3e-9)^(2/3) m = 1.19114 um. The contact's stiffness there is
    # (3/2) 10 N / 1.19114 um = 12.5929 MN / m, and the bead's mass (4/3) pi a^3 7800 kg/m^3 = 4.08407 g: sqrt(m / k) = 18.0087 us.
    steel = tc.Scaling(**STEEL)
    assert steel.contact_constant == pytest.approx(7.69231e9, rel=1e-6)
    assert steel.overlap == pytest.approx(1.19114e-6, rel=1e-5)
    assert steel.unit("stiffness") == pytest.approx(12.5930e6, rel=1e-5)
    assert steel.unit("mass") == pytest.approx(4.08407e-3, rel=1e-6)
    assert steel.unit("time") == pytest.approx(18.0087e-6, rel=1e-5)
    assert steel.sound_speed == pytest.approx((10e-3 - 1.19114e-6) / 18.0087e-6, rel=1e-5)  # 555 m/s
    assert steel.unit("frequency") == pytest.approx(8837.6, rel=1e-4)  # the ordered chain passes up to twice that


def test_glass_bead_by_hand():
    # E* = 36.4583 GPa, R* = 0.5 mm, F = 1.08698e9 N / m^(3/2) delta^(3/2): 0.1 N make 0.203784 um, k = 0.736074 MN/m; the
    # bead's mass is 10.4720 mg: sqrt(m / k) = 3.77184 us.
    glass = tc.Scaling(**GLASS)
    assert glass.contact_constant == pytest.approx(4 / 3 * 36.4583333e9 * math.sqrt(0.5e-3), rel=1e-8)
    assert glass.overlap == pytest.approx((0.1 / glass.contact_constant) ** (2 / 3), rel=1e-12)
    assert glass.unit("mass") == pytest.approx(10.4720e-6, rel=1e-5)
    assert glass.unit("time") == pytest.approx(math.sqrt(10.4720e-6 / (0.15 / glass.overlap)), rel=1e-5)


@pytest.mark.parametrize("beads", [STEEL, GLASS])
def test_units_are_consistent(beads):
    unit = tc.Scaling(**beads).unit
    length, time, mass = unit("length"), unit("time"), unit("mass")
    assert unit("velocity") == pytest.approx(length / time)
    assert unit("force") == pytest.approx(mass * length / time**2)
    assert unit("energy") == pytest.approx(mass * (length / time) ** 2)
    assert unit("stiffness") == pytest.approx(mass / time**2)
    assert unit("damping") == pytest.approx(mass / time)
    assert unit("frequency") == pytest.approx(1 / (2 * math.pi * time))
    # F = (2/3) delta^(3/2) of the dimensionless contact is the precompression at overlap 1 (Eq. 7 made consistent with Eq. 13).
    assert tc.Scaling(**beads).to_si("force", 2 / 3) == pytest.approx(beads["force"], rel=1e-12)


def test_hertz_contact_in_si_is_the_chains_contact():
    # Two beads held by walls, the first pushed by x meters: the force on it from kappa delta^(3/2) on both sides.
    steel = tc.Scaling(**STEEL)
    x = 0.3 * steel.overlap
    kappa = steel.contact_constant
    expected = kappa * ((steel.overlap - x) ** 1.5 - (steel.overlap + x) ** 1.5)
    chain = tc.Chain(torch.ones(2, dtype=torch.float64), "fixed", contact="hertz")
    force = chain.force(torch.tensor([steel.from_si("length", x), 0.0], dtype=torch.float64))[0].item()
    assert steel.to_si("force", force) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_round_trip(quantity):
    steel = tc.Scaling(**STEEL)
    assert steel.from_si(quantity, steel.to_si(quantity, 0.37)) == pytest.approx(0.37, rel=1e-15)
    values = torch.linspace(-1, 1, 5, dtype=torch.float64)
    torch.testing.assert_close(steel.to_si(quantity, steel.from_si(quantity, values)), values, rtol=1e-15, atol=0)
    array = np.array([1.0, 2.0])
    assert isinstance(steel.to_si(quantity, array), np.ndarray)
    np.testing.assert_allclose(steel.to_si(quantity, array), array * steel.unit(quantity))


def test_scaling_with_force():
    # Overlap ~ P^(2/3), stiffness ~ P^(1/3), time ~ P^(-1/6): the sound speed of a precompressed chain ~ P^(1/6).
    one, eight = tc.Scaling(**STEEL), tc.Scaling(**STEEL | {"force": 80.0})
    assert eight.overlap / one.overlap == pytest.approx(4)
    assert eight.unit("stiffness") / one.unit("stiffness") == pytest.approx(2)
    assert eight.sound_speed / one.sound_speed == pytest.approx(math.sqrt(2), rel=1e-3)  # the spacing shrinks a little


def si_scene(**changes):
    """A kick of 1 mm/s at one end of 200 steel beads, for 2 ms, all in SI units."""
    table = {**STEEL, "velocity": 1e-3, "times": {"start": 0.0, "stop": 2.4e-3, "step": 0.2e-3}}
    plain = {
        "n_particles": 200, "boundary": "fixed", "disorder": {"strength": 0.0}, "excitation": {"kind": "impulse"},
        "observables": ["energy", "center"], "si": table,
    }  # fmt: skip
    return tc.Scene.from_dict(plain | changes)


def test_front_in_si_travels_at_the_sound_speed():
    data = tc.simulate(si_scene(), "chebyshev")
    speed = tc.Scaling(**STEEL).sound_speed
    late = slice(4, None)
    time, place = data.time_si.values[late], data.place_si.values
    assert time[-1] == pytest.approx(2.4e-3, rel=1e-12)
    # The foremost particle with a tenth of the largest energy runs ahead of the sound by a few particles at most, and the
    # front widens as t^(1/3): over 80 particles that is 5 %.
    energy = data.energy.values[late]
    ahead = np.array([place[np.flatnonzero(e > 0.1 * e.max())[-1]] for e in energy])
    assert np.polyfit(time, ahead, 1)[0] == pytest.approx(speed, rel=0.05)
    # The center of energy goes at 32 / (15 pi) of it, which has no such width.
    center = data.center.values[late] * tc.Scaling(**STEEL).spacing
    assert np.polyfit(time, center, 1)[0] == pytest.approx(BALLISTIC * speed, rel=1e-3)


def test_si_scene_is_the_dimensionless_scene():
    steel = tc.Scaling(**STEEL)
    scene = si_scene()
    assert scene.si == steel
    assert scene.excitation.velocity == pytest.approx(1e-3 * steel.unit("time") / steel.overlap)
    assert scene.times[-1].item() == pytest.approx(2.4e-3 / steel.unit("time"))
    by_hand = tc.Scene(
        n_particles=200, boundary="fixed", disorder=tc.Disorder(strength=0.0), observables=("energy",), times=scene.times,
        excitation=tc.Impulse(velocity=scene.excitation.velocity),
    )  # fmt: skip
    np.testing.assert_array_equal(
        tc.simulate(by_hand, "chebyshev").energy.values, tc.simulate(scene, "chebyshev").energy.values
    )


def test_si_scene_with_amplitude_damping_and_a_list_of_times(tmp_path):
    text = """
        n_particles = 32
        n_bands = 4
        [excitation]
        tones = [4]
        [si]
        radius = 5e-3
        density = 7800
        young_modulus = 210e9
        poisson_ratio = 0.3
        force = 10
        amplitude = 1e-8
        damping = 2.0
        times = [0.0, 1e-4]
    """
    (tmp_path / "scene.toml").write_text(text)
    scene, steel = tc.Scene.from_toml(tmp_path / "scene.toml"), tc.Scaling(**STEEL)
    assert scene.excitation.amplitude == pytest.approx(1e-8 / steel.overlap)
    assert scene.damping == pytest.approx(2.0 * steel.unit("time") / steel.unit("mass"))
    assert scene.times.tolist() == pytest.approx([0, 1e-4 / steel.unit("time")])
    again = tc.Scene.from_dict(scene.to_dict())  # what a run folder holds: dimensionless fields, and the beads
    assert again.si == scene.si
    assert torch.equal(again.times, scene.times)
    assert again.excitation == scene.excitation


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"radius": 0.0}, FieldError, "si.radius must be greater than 0, got 0"),
        ({"radius": "5 mm"}, FieldTypeError, "si.radius must be a number, got '5 mm'"),
        ({"density": -7800.0}, FieldError, "si.density must be greater than 0, got -7800"),
        ({"young_modulus": math.inf}, FieldError, "si.young_modulus must be finite, got inf"),
        ({"poisson_ratio": 0.6}, FieldError, "si.poisson_ratio must be at most 0.5, got 0.6"),
        ({"poisson_ratio": -1.0}, FieldError, "si.poisson_ratio must be greater than -1, got -1"),
        ({"force": math.nan}, FieldError, "si.force must be finite, got nan"),
        ({"force": 1e7}, FieldError, "si.force must make an overlap below a tenth of the radius, .* got 10000000"),
    ],
)
def test_bad_beads(changes, error, message):
    with pytest.raises(error, match=message):
        tc.Scaling(**STEEL | changes)


@pytest.mark.parametrize("quantity", ["colour", "", None])
def test_bad_quantity(quantity):
    with pytest.raises((FieldError, FieldTypeError), match="quantity must be"):
        tc.Scaling(**STEEL).unit(quantity)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"si": {"radius": 1e-3}}, FieldError, "si must have density, young_modulus, poisson_ratio, force, got"),
        ({"si": STEEL | {"colour": 1}}, FieldError, "si .*colour"),
        ({"si": STEEL | {"radius": -1.0}}, FieldError, "si.radius must be greater than 0, got -1"),
        ({"si": 3}, FieldTypeError, "si must be a table, got 3"),
        ({"si": STEEL | {"times": [0.0, 1e-3]}, "times": [0.0, 1.0]}, FieldError, "times must be given once, here or as si.times"),
        ({"si": STEEL | {"velocity": 1e-3}, "excitation": {"kind": "impulse", "velocity": 0.01}}, FieldError,
         "velocity must be given once, here or as si.velocity, got 0.01"),
        ({"si": STEEL | {"damping": 1.0}, "damping": 0.1}, FieldError, "damping must be given once"),
        ({"si": STEEL | {"damping": -1.0}}, FieldError, "si.damping must be at least 0, got -1"),
        ({"si": STEEL | {"amplitude": 1e-8}}, FieldError, "amplitude"),  # an impulse has none
        ({"si": STEEL | {"velocity": math.nan}}, FieldError, "si.velocity must be finite, got nan"),
    ],
)  # fmt: skip
def test_bad_si_scenes(changes, error, message):
    with pytest.raises(error, match=message):
        si_scene(**changes)


def test_a_kick_too_hard_for_linear_contacts_is_refused():
    # 1 m/s is 15 overlaps per unit of time: the contact opens.
    scene = si_scene(si={**STEEL, "velocity": 1.0, "times": [0.0, 1e-4]})
    with pytest.raises(FieldError, match="excitation must stretch no linear contact beyond the initial overlap 1"):
        tc.simulate(scene, "chebyshev")


def test_masses_in_other_units_are_remarked_upon():
    chain = tc.Chain(torch.full((16,), 2.5e-4, dtype=torch.float64))
    with pytest.warns(tc.UnitsWarning, match=r"masses have mean 0\.00025, .* travels 63\.2 particles per unit of time"):
        tc.evolve(chain, tc.impulse(chain), [0.0, 1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for factor in (0.6, 1.9):  # a mean by chance
            usual = tc.Chain(factor * torch.ones(16, dtype=torch.float64))
            tc.evolve(usual, tc.impulse(usual), [0.0, 1.0])
    cut = tc.Disorder("gamma", 5.0)  # most of its values are below 0.05, and drawn again
    with pytest.warns(tc.UnitsWarning, match=r"masses have mean [3-6]\.\d+, where the unit of mass is their mean"):
        tc.simulate(tc.Scene(n_particles=16, n_bands=4, realizations=4, times=[1.0], disorder=cut), "modes")
