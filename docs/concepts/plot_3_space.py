"""
Energy in space
===============

A kick on one bead sends a front of energy along the chain. Disorder holds some of it back. Two numbers sum that up: the **center of
energy** R(t) (Eq. 37), the mean position of the energy, and its **squared width** r\\ :sup:`2`\\ (t) (Eq. 38), the variance of that position.
"""

import matplotlib.pyplot as plt

import torchchain as tc

figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
for strength in (0.0, 0.1, 0.3):
    scene = tc.Scene(
        n_particles=200, boundary="fixed", disorder=tc.Disorder(strength=strength), excitation=tc.Impulse(site=1),
        observables=("energy", "center"), times=[float(t) for t in range(0, 161, 4)], realizations=50, seed=0,
    )  # fmt: skip
    result = tc.simulate(scene, method="modes")
    late = result.energy.sel(time=160.0)
    left.semilogy(late.particle, late, label=f"$\\xi$ = {strength}")
    right.plot(result.time, result.center)
    if strength:
        low, high = result.center - result.center_stderr, result.center + result.center_stderr
        right.fill_between(result.time, low, high, alpha=0.3)
left.set(xlabel="bead", ylabel="share of the energy at t = 160", ylim=(1e-5, 1))
right.set(xlabel="time t", ylabel="center of energy R")
left.legend()
plt.show()

# %%
# Every number is a mean over 50 chains and comes with its standard error (the shaded bands).
