import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError

CHAIN = tc.Chain(torch.ones(3, 8, dtype=torch.float64))


def test_impulse():
    state = tc.impulse(CHAIN, site=3, velocity=-0.02)
    assert not state.displacement.any()
    expected = np.zeros((3, 8))
    expected[:, 2] = -0.02
    np.testing.assert_array_equal(state.velocity.numpy(), expected)


@pytest.mark.parametrize("phase", ["sin", "cos"])
@pytest.mark.parametrize("tone", [1, 2, 3])
def test_standing_wave(tone, phase):
    state = tc.standing_wave(CHAIN, tone, amplitude=0.5, phase=phase)
    particle = np.arange(1, 9)
    wave = 0.5 * getattr(np, phase)(2 * np.pi * tone * particle / 8)
    assert state.displacement.shape == (3, 8)
    np.testing.assert_allclose(state.displacement.numpy(), np.tile(wave, (3, 1)), atol=1e-15)
    assert not state.velocity.any()
    spectrum = np.abs(np.fft.rfft(state.displacement[0].numpy()))
    assert spectrum[tone] == pytest.approx(0.5 * 8 / 2, rel=1e-14)
    assert np.delete(spectrum, tone).max() < 1e-14


def test_cosine_at_the_zone_boundary():
    state = tc.standing_wave(CHAIN, 4, amplitude=1.0, phase="cos")
    np.testing.assert_allclose(state.displacement[0].numpy(), [-1, 1] * 4, rtol=1e-14)


def test_high_tones_of_long_chains_keep_their_phase():
    n, tone = 2**20, 2**19 - 1  # k p reaches 3e6: a phase formed in radians would lose 7 digits
    state = tc.standing_wave(tc.Chain(torch.ones(n, dtype=torch.float64)), tone, amplitude=1.0)
    p = n - 3
    # sin(2 pi (n/2 - 1) (n - 3) / n) = sin(-3 pi + 6 pi / n + integer turns) = -sin(6 pi / n - ...) by exact reduction
    turns = (tone * p) % n
    assert state.displacement[p - 1].item() == pytest.approx(np.sin(2 * np.pi * turns / n), abs=1e-15)


def test_several_tones_are_runs_of_their_own():
    state = tc.standing_wave(CHAIN, (1, 3))
    assert state.displacement.shape == (3, 2, 8)
    for i, tone in enumerate((1, 3)):
        assert torch.equal(state.displacement[:, i], tc.standing_wave(CHAIN, tone).displacement)
    assert torch.equal(tc.standing_wave(CHAIN, np.array([1, 3])).displacement, state.displacement)
    assert tc.standing_wave(CHAIN, np.int64(3)).displacement.shape == (3, 8)


def test_superposition():
    a, b = tc.impulse(CHAIN), tc.standing_wave(CHAIN, 2)
    both = a + b
    assert torch.equal(both.velocity, a.velocity)
    assert torch.equal(both.displacement, b.displacement)


def test_states_follow_the_chain():
    chain = tc.Chain(torch.ones(8, dtype=torch.float32))
    assert tc.impulse(chain).velocity.dtype == torch.float32
    assert tc.standing_wave(chain).displacement.dtype == torch.float32


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: tc.impulse(CHAIN, 0), FieldError, "site must be at least 1, got 0"),
        (lambda: tc.impulse(CHAIN, 9), FieldError, "site must be at most 8, got 9"),
        (lambda: tc.impulse(CHAIN, 1.0), FieldTypeError, "site must be an integer"),
        (lambda: tc.impulse(CHAIN, True), FieldTypeError, "site must be an integer"),
        (lambda: tc.impulse(CHAIN, 1, float("nan")), FieldError, "velocity must be finite"),
        (lambda: tc.impulse(CHAIN, 1, "fast"), FieldTypeError, "velocity must be a number"),
        (lambda: tc.standing_wave(CHAIN, 0), FieldError, "tone must be at least 1, got 0"),
        (lambda: tc.standing_wave(CHAIN, 5), FieldError, "tone must be at most 4, got 5"),
        (lambda: tc.standing_wave(CHAIN, 4), FieldError, "tone must be less than n_particles/2 = 4 for phase 'sin'"),
        (lambda: tc.standing_wave(CHAIN, [1, 4]), FieldError, "tone must be less than n_particles/2 = 4"),
        (lambda: tc.standing_wave(CHAIN, []), FieldError, "tone must hold at least one tone"),
        (lambda: tc.standing_wave(CHAIN, 1.5), FieldTypeError, "tone must be an integer, got 1.5"),
        (lambda: tc.standing_wave(CHAIN, None), FieldTypeError, "tone must be an integer, got None"),
        (lambda: tc.standing_wave(CHAIN, True), FieldTypeError, "tone must be an integer, got True"),
        (lambda: tc.standing_wave(CHAIN, "1"), FieldTypeError, "tone must be an integer"),
        (lambda: tc.standing_wave(CHAIN, 1, phase="tan"), FieldError, "phase must be one of sin, cos, got 'tan'"),
        (lambda: tc.standing_wave(CHAIN, 1, float("inf")), FieldError, "amplitude must be finite"),
        (lambda: tc.State(torch.zeros(8), torch.zeros(3)), FieldError, "velocity must have the displacement's shape"),
        (lambda: tc.State(0.0, 0.0), FieldError, "displacement must have particles on its last axis"),
        (lambda: tc.State([0.0, float("nan")], [0, 0]), FieldError, "displacement must be finite"),
        (lambda: tc.State([0.0, 1j], [0, 0]), FieldTypeError, "displacement must be real"),
        (lambda: tc.Impulse(site=0), FieldError, "excitation.site must be at least 1"),
        (lambda: tc.Impulse(site=1.5), FieldTypeError, "excitation.site must be an integer"),
        (lambda: tc.Impulse(velocity=0), FieldError, "excitation.velocity must have a size between"),
        (lambda: tc.Impulse(velocity=1e200), FieldError, "excitation.velocity must have a size between"),
        (lambda: tc.Impulse(velocity=float("nan")), FieldError, "excitation.velocity must be finite"),
        (lambda: tc.StandingWave(amplitude=-0.0), FieldError, "excitation.amplitude must have a size between"),
        (lambda: tc.StandingWave(amplitude=1e-200), FieldError, "excitation.amplitude must have a size between"),
        (lambda: tc.StandingWave(phase="tan"), FieldError, "excitation.phase must be one of"),
        (lambda: tc.StandingWave(tones=()), FieldTypeError, "excitation.tones must be a list of integers"),
        (lambda: tc.StandingWave(tones="12"), FieldTypeError, "excitation.tones must be a list of integers"),
        (lambda: tc.StandingWave(tones=(1, 1)), FieldError, "excitation.tones must be different"),
        (lambda: tc.StandingWave(tones=(0,)), FieldError, "excitation.tones must be at least 1"),
        (lambda: tc.StandingWave(tones=(1.5,)), FieldTypeError, "excitation.tones must be an integer"),
    ],
)
def test_bad_values(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_a_batch_of_waves_may_be_changed_chain_by_chain():
    chain = tc.Chain(tc.Disorder().masses(8, 3, 0))
    state = tc.standing_wave(chain, [1, 2])
    before = state.displacement.clone()
    state.displacement[1, 0, 4] = 7.0
    state.velocity[1, 0, 4] = 7.0
    assert torch.equal(state.displacement[[0, 2]], before[[0, 2]])
    assert float(state.velocity.sum()) == 7.0
