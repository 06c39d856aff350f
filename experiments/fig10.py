"""Fig. 10: energy of every particle, from the same chains as Fig. 9."""

from __future__ import annotations

import sys
from dataclasses import replace

import fig09
import harness
import xarray
from fig09 import CASES, TITLES, Config, mark_lightest
from matplotlib.figure import Figure

from torchchain import plots


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, len(CASES), height=5.4)
    for ax, case, title in zip(axes[0], CASES, TITLES, strict=True):
        energy = data.energy.sel(case=case).values
        plots.log_map(
            ax, data.particle.values, data.time.values, energy.T / energy.sum(-1).mean(), "particle $p$", plots.TIME_LABEL,
            "share of the energy $TE$", floor=1e-4, top=1e-1,
        )  # fmt: skip
        ax.set_title(title.format(config.strength), pad=12)
        mark_lightest(ax, data.mass.sel(case=case).values)
    figure.suptitle(f"standing wave of tone {config.tone}, one chain; triangles: its five lightest particles")
    return figure


SCRIPT = replace(fig09.SCRIPT, name="fig10", draw=draw)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
