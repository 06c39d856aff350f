"""
Band transfer
=============

The **band transfer** is the table T[source, time, receiver]: start in the middle tone of the source band, and see which share of the energy is in
the receiver band at a time, on average over many chains. Each row adds up to 1, since energy is conserved. As time goes on it settles to
the **long-time** table, which the normal modes give exactly, without any stepping in time.
"""

import matplotlib.pyplot as plt

import torchchain as tc

scene = tc.Scene(
    n_particles=128,
    n_bands=16,
    disorder=tc.Disorder(strength=0.3),
    realizations=50,
    times=[0.0, 1.0, 4.0, 16.0],
    seed=0,
)
transfer = tc.band_transfer(scene, method="modes")
print(transfer.mean.shape, transfer.long_time.shape)  # [source, time, receiver], [source, receiver]

figure, axes = plt.subplots(1, 4, figsize=(9, 2.6), sharey=True, layout="constrained")
tables = [(f"t = {transfer.times[i]:g}", transfer.mean[:, i]) for i in (1, 2, 3)] + [("t → ∞", transfer.long_time)]
for axis, (title, table) in zip(axes, tables, strict=True):
    image = axis.imshow(table, origin="lower", extent=(0.5, 16.5, 0.5, 16.5), cmap="magma", vmin=0, vmax=0.4)
    axis.set(title=title, xlabel="receiver band")
axes[0].set_ylabel("source band")
figure.colorbar(image, ax=axes, label="share of the energy")
plt.show()
