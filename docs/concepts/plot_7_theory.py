"""
Theory
======

For rings with random masses the mean band transfer can be computed without a single chain, from the distribution of the masses
alone: an effective medium, multiple scattering that conserves energy, and the return of localized waves. :doc:`/theory` derives it.
"""

import matplotlib.pyplot as plt

import torchchain as tc

scene = tc.Scene(n_particles=128, n_bands=16, disorder=tc.Disorder(strength=0.3), realizations=100, seed=0)
chains = tc.band_transfer(scene, method="modes")
theory = tc.band_transfer(scene, method="theory")

figure, axis = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
for i, band in enumerate((4, 8, 12)):
    mean, error = chains.mean[band - 1, :, band - 1], chains.stderr[band - 1, :, band - 1]
    axis.fill_between(
        chains.times, mean - error, mean + error, color=f"C{i}", alpha=0.35, label=f"band {band}, 100 chains"
    )
    axis.plot(theory.times, theory.mean[band - 1, :, band - 1], "k--", lw=1)
axis.plot([], [], "k--", label="theory, no chains")
axis.set(xlabel="time t", ylabel="energy left in the source band", xlim=(0, 50))
axis.legend(fontsize="small")
plt.show()
