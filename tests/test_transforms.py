"""Evolution and energies under torch.func: the same numbers as without, and gradients as by backward()."""

import pytest
import torch
from torch.func import grad, jacrev, vmap

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.evolvers import METHODS, kernels, register_method

TIMES = [0.5, 3.0, 20.0]
WAYS = [("modes", {}), ("chebyshev", {"compiled": False}), ("chebyshev", {})]


def inputs():
    generator = torch.Generator().manual_seed(0)
    u, v = 0.01 * torch.randn(2, 3, 6, generator=generator, dtype=torch.float64)
    return tc.Disorder().masses(6, 3, 0), u, v


def outcome(method, options, boundary):
    def observed(masses, u, v):
        chain = tc.Chain(masses, boundary)
        states = tc.evolve(chain, tc.State(u, v), TIMES, method, **options)
        site = tc.particle_energy(chain, states)[..., 0]
        return site.sum() + tc.band_energy(chain, states, 3)[..., 0].sum() + states.velocity[..., 1].sum()

    return observed


@pytest.mark.parametrize(("method", "options"), WAYS)
@pytest.mark.parametrize("boundary", ["fixed", "periodic"])
def test_grad_and_vmap_give_what_backward_and_a_batch_give(method, options, boundary):
    observed, given = outcome(method, options, boundary), inputs()
    leaves = [x.clone().requires_grad_() for x in given]
    observed(*leaves).backward()
    for argnum, leaf in enumerate(leaves):
        for gradient in (grad(observed, argnum)(*given), vmap(grad(observed, argnum))(*given)):
            torch.testing.assert_close(gradient, leaf.grad, rtol=1e-8, atol=1e-9)
    each = vmap(observed)(*given)
    torch.testing.assert_close(each.sum(), observed(*given), rtol=1e-10, atol=0)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("boundary", ["fixed", "periodic"])
def test_second_derivatives_by_modes_are_those_by_chebyshev(boundary, moving):
    masses, u, v = inputs()

    def observed(method):
        def of(masses):
            state = tc.State(u[0], v[0] if moving else 0 * v[0])
            return tc.evolve(tc.Chain(masses, boundary), state, [0.0, *TIMES], method).displacement.square().sum()

        return of

    wanted = torch.autograd.functional.hessian(observed("chebyshev"), masses[0])
    for second in (jacrev(grad(observed("modes"))), lambda m: torch.autograd.functional.hessian(observed("modes"), m)):
        torch.testing.assert_close(second(masses[0]), wanted, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("method", ["verlet", "symplectic4", "dopri5", "rk4"])
def test_what_torch_func_cannot_trace_is_one_line(method):
    given = inputs()
    with pytest.raises(FieldError, match=f"method must be 'modes' or 'chebyshev' under torch.func .*, got {method}"):
        grad(outcome(method, {}, "periodic"))(*given)


def test_a_method_of_ones_own():
    def start(chain, state):
        return lambda times: tc.Trajectory(
            times,
            state.displacement[..., None, :] + times[:, None] * state.velocity[..., None, :],
            state.velocity[..., None, :].expand(*state.velocity.shape[:-1], len(times), chain.n_particles),
        )

    own = tc.register_method(tc.Method("free_flight", start, "no contacts at all"))
    try:
        chain = tc.Chain(torch.ones(4, dtype=torch.float64))
        moved = tc.evolve(chain, tc.impulse(chain, 2, 0.5), [2.0], "free_flight")
        assert moved.displacement[0].tolist() == [0, 1, 0, 0]
        for wrong, message in ((own, "be free"), (tc.Method("two words", start, ""), "be an identifier")):
            with pytest.raises(ValueError, match=message):
                register_method(wrong)
        with pytest.raises(TypeError, match="method must be a Method"):
            register_method("modes")
    finally:
        del METHODS["free_flight"]


def test_a_trajectory_has_one_state_a_time():
    states = torch.zeros(11, 4, dtype=torch.float64)
    with pytest.raises(
        ValueError, match=r"trajectory.displacement must have shape .* with 3 times, got shape \(11, 4\)"
    ):
        tc.Trajectory(torch.arange(3.0), states, states)
    with pytest.raises(ValueError, match=r"trajectory.velocity must have shape \(11, 4\)"):
        tc.Trajectory(torch.arange(11.0), states, states[:, :2])
    with pytest.raises(ValueError, match=r"trajectory.dissipated must have shape \(11,\)"):
        tc.Trajectory(torch.arange(11.0), states, states, states)


def test_compiling_is_announced_once(monkeypatch, caplog):
    class Kernel:
        signatures = ()

    monkeypatch.setattr(kernels, "_said", False)
    monkeypatch.setattr(kernels, "at_hand", lambda kernel: bool(kernel.signatures))
    with caplog.at_level("WARNING", logger="torchchain"):
        for _ in range(2):
            kernels.announce(Kernel())
    assert [record.getMessage() for record in caplog.records] == ["compiling kernels once, some 20 s ..."]


def test_seconds_are_counted_while_kernels_are_compiled(monkeypatch):
    counted = []
    monkeypatch.setattr(
        kernels.time, "sleep", lambda seconds: counted.append(seconds) or kernels.event.end_event("numba:compile")
    )
    monkeypatch.setattr(kernels, "IDLE", -1.0)
    compiling = kernels._Compiling()
    with kernels.event.install_listener("numba:compile", compiling):
        kernels.event.start_event("numba:compile")
        assert not compiling.ended
        kernels.event.end_event("numba:compile")
    assert compiling.ended
    monkeypatch.setattr(kernels, "_Compiling", lambda: compiling)
    compiling.open = 3  # kernels that others call are compiled within their compilation
    kernels._count()
    assert counted == [1.0] * 3


def test_a_compiled_kernel_is_at_hand(tmp_path, monkeypatch):
    import importlib.util

    source = tmp_path / "tiny_kernel.py"
    source.write_text("import numba\n\n\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n")
    found = []
    for _ in range(2):  # compiled, then from the cache of a process before
        spec = importlib.util.spec_from_file_location("tiny_kernel", source)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        found.append(kernels.at_hand(module.twice))
        assert module.twice(2) == 4
        assert kernels.at_hand(module.twice)
    assert found == [False, True]
