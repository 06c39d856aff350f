"""
Noise
=====

An ensemble of R chains has a statistical error that falls as 1 / :math:`\\sqrt{R}`. **The noise** on these pages is the
mean total variation between two such ensembles. It is the yardstick: a model closer to the ensemble than the noise cannot be told from
it, and a method more accurate than the noise is a waste.
"""

import matplotlib.pyplot as plt

import torchchain as tc

figure, axis = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
sizes, measured, predicted = (10, 20, 40, 80, 160), [], []
for size in sizes:
    pair = [
        tc.band_transfer(
            tc.Scene(n_particles=64, n_bands=8, realizations=size, seed=seed, times=[0.0, 10.0, 20.0, 40.0]),
            method="modes",
        )
        for seed in (1, 2)
    ]
    measured.append(tc.total_variation(pair[0].mean, pair[1].mean)[:, 1:].mean())
    predicted.append(tc.statistical_distance(pair[0].stderr)[:, 1:].mean())
axis.loglog(sizes, measured, "o", label="two ensembles, measured")
axis.loglog(sizes, predicted, "k--", label="from the standard errors of one of them")
axis.set(xlabel="chains in each ensemble", ylabel="mean total variation")
axis.legend(fontsize="small")
plt.show()
