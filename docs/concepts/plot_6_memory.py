"""
Memory
======

Constant rates forget where the energy came from: what flows next depends on where the energy is now. Then two steps of time t would be one step
of 2t, T(2t) = T(t)\\ :sup:`2`. For real chains that fails by many times the statistical error: some of the energy is bound to come
back or to stay. The model ``memory`` therefore describes each pair of bands by a few decaying and oscillating functions of time,
shared by all pairs, instead of rates.
"""

import matplotlib.pyplot as plt

import torchchain as tc

scene = tc.Scene(
    n_particles=128, n_bands=16, disorder=tc.Disorder(strength=0.3), realizations=100, seed=0,
    times=[0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0],
)  # fmt: skip
transfer = tc.band_transfer(scene, method="modes")
test = [tc.chapman_kolmogorov(transfer, lag=lag, multiples=(2,)) for lag in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)]

figure, axis = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
axis.loglog([t.lag for t in test], [t.distance.mean() for t in test], "o-", label="T(2t) and T(t)$^2$")
axis.loglog(
    [t.lag for t in test], [t.statistical.mean() for t in test], "s--", label="by chance, for a chain without memory"
)
axis.set(xlabel="time t", ylabel="mean total variation")
axis.legend(fontsize="small")
plt.show()

# %%
# **Total variation** is the distance used on all these pages: half the sum of the differences between two distributions over
# bands, from 0 (equal) to 1 (no band in common).
