"""
Master equation
===============

A **master equation** says how fast energy flows from band s to band r: rate Q[s, r]. What flows out of one band flows into the others, so that each
row of Q adds up to zero. Without disorder nothing flows. In the paper's model (Eq. 48) a part of the energy, the **basis energy**
(Eq. 47), stays where it was, and the rest follows Q. To **calibrate** is to find such numbers from a band transfer;
the calibrated model then predicts band energies at any time in a fraction of a millisecond, without chains.
"""

import matplotlib.pyplot as plt
import torch

import torchchain as tc

scene = tc.Scene(n_particles=128, n_bands=16, disorder=tc.Disorder(strength=0.3), realizations=100, seed=0)
transfer = tc.band_transfer(scene, method="modes")
paper = tc.calibrate(transfer, model="paper", method="linear")
best = tc.calibrate(transfer)  # picks a model by its error on chains that it was not fitted to

figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
limit = float(paper.rates.detach().abs().max())
image = axes[0].imshow(
    paper.rates.detach(), origin="lower", extent=(0.5, 16.5, 0.5, 16.5), cmap="RdBu_r", vmin=-limit, vmax=limit
)
axes[0].set(xlabel="to band r", ylabel="from band s", title="rates Q[s, r]")
figure.colorbar(image)
start = torch.zeros(16, dtype=torch.float64)
start[10] = 1.0  # all energy in band 11
for model, style, name in ((paper, ":", "paper's model"), (best, "-", "chosen model")):
    energy = model.solve(start, transfer.times).detach()
    for band, color in ((11, "C0"), (14, "C1")):
        axes[1].plot(transfer.times, energy[:, band - 1], style, color=color, label=f"{name}, band {band}")
for band, color in ((11, "C0"), (14, "C1")):
    axes[1].plot(transfer.times[::4], transfer.mean[10, ::4, band - 1], ".", ms=3, color=color)
axes[1].set(xlabel="time t", ylabel="share of the energy", title="start in band 11 (dots: chains)", ylim=(0, 0.6))
axes[1].legend(fontsize="small")
plt.show()
