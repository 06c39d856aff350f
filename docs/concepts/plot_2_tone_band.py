"""
Tone and band
=============

A **tone** is a standing wave that fits the ring: tone n has n wavelengths in N beads, hence the **wavenumber** k = 2 :math:`\\pi` n / N.
The highest tone, N / 2, has one wavelength in two beads, k = :math:`\\pi`.

A **band** is a range of wavenumbers. The N / 2 tones are sorted into B bands of equal width; band 1 holds the longest waves.
Start a disordered chain in a single tone, the **source**, and its energy wanders into the other bands, the **receivers**.
"""

import matplotlib.pyplot as plt
import torch

import torchchain as tc

masses = tc.Disorder(strength=0.3).masses(n_particles=256, realizations=1, seed=0)
chain = tc.Chain(masses, boundary="periodic")
times = torch.linspace(0, 60, 121, dtype=torch.float64)
path = tc.evolve(chain, tc.standing_wave(chain, tone=90), times, method="modes")
energy = tc.band_energy(chain, path, n_bands=32)[0]  # (time, band), each row adds up to 1

figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), width_ratios=(1, 1.6), layout="constrained")
for tone, shift in ((2, 0), (90, -2.5)):
    left.plot(range(1, 41), tc.standing_wave(chain, tone=tone).displacement[0, :40] * 100 + shift, ".-", lw=0.8)
    left.text(40, shift + 1.1, f"tone {tone}", ha="right")
left.set(xlabel="bead", yticks=[], title="two tones, the first 40 beads", ylim=(-3.8, 1.6))
image = right.imshow(energy.T, origin="lower", aspect="auto", extent=(0, 60, 0.5, 32.5), cmap="magma", vmax=0.3)
figure.colorbar(image, label="share of the energy")
right.set(xlabel="time t", ylabel="band", title="one chain, started in tone 90 of band 23")
plt.show()
