"""Fig. 15: the reverse of Fig. 14, decay of the energy in band 20 and its rise in band 23."""

from __future__ import annotations

import sys
from dataclasses import replace

import fig14
import harness

BANDS = {"source": 20, "receiver": 23}
SCRIPT = replace(
    fig14.SCRIPT, name="fig15", config=fig14.Config(**BANDS), smoke=replace(fig14.SMOKE, **BANDS)
)  # the same chains


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
