"""Fig. 3: mean energy of every particle at several instants after a kick beside the wall, moderate and strong disorder."""

from __future__ import annotations

import sys
from dataclasses import replace

import fig02
import harness

STRENGTHS = (0.1, 0.3)
SCRIPT = fig02.script(
    "fig03", replace(fig02.Config(), strengths=STRENGTHS), replace(fig02.SMOKE, strengths=STRENGTHS)
)  # the same chains


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
