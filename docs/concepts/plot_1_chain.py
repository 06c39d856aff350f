"""
Chain
=====

A **chain** is a row of beads, each touching its two neighbors. It is pressed together beforehand, so that small motions
never open a contact and every contact acts like a spring. Two **boundaries**: ``periodic``, where the last bead touches the first (a
ring), and ``fixed``, where both ends touch walls.

**Disorder** means that the masses are random. Its strength :math:`\\xi` is the standard deviation of the masses, whose mean is 1.
Times are in units in which sound crosses one bead of an ordered chain in time 1, lengths in beads, so that the speed of sound is 1 too.
"""

import matplotlib.pyplot as plt
import torch

import torchchain as tc

masses = tc.Disorder(strength=0.3).masses(n_particles=60, realizations=1, seed=0)
chain = tc.Chain(masses, boundary="periodic")

figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 3.6), height_ratios=(1, 2), layout="constrained")
size = 220 * masses[0] ** (2 / 3)
top.scatter(range(1, 61), torch.zeros(60), s=size, c=masses[0], cmap="viridis", edgecolors="0.2", linewidths=0.5)
top.set(yticks=[], xlabel="bead", title="beads of a chain with $\\xi$ = 0.3, darker where lighter")

# %%
# The **normal modes** of such a chain are the patterns that oscillate at one frequency. Long waves hardly notice the disorder;
# the modes of the highest frequencies sit on a few light beads. That is **localization**.
modes = tc.normal_modes(chain)
for number in (3, 45, 60):
    shape = modes.shapes[0, :, number - 1]
    bottom.plot(range(1, 61), shape, label=f"mode {number}, frequency {modes.frequencies[0, number - 1]:.2f}")
bottom.set(xlabel="bead", ylabel="displacement")
bottom.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1, 1))
plt.show()
