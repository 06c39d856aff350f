"""How the Chebyshev expansion of the exact motion is cut into segments of time, and how many terms they take."""

from __future__ import annotations

import math

# A stretch of time with z beyond this is crossed in equal leaps. Longer ones save little, as the degree is z / 2 and a
# few, while rounding errors of the recursion grow with its degree.
LEAP = 256.0
# The outputs that follow a state until z exceeds SHARED_PHASE, at most LONGEST, share the kernels' recursion: the work per
# output, degree(z) stencils for all of them plus two sums each, is flat around this minimum.
SHARED_PHASE = 24.0
LONGEST = 8  # outputs
SEGMENTS = 1024  # outputs at a time
ROUNDING = 2.0**-53  # relative, of float64


def terms(z: float, accuracy: float) -> float:
    """Chebyshev terms for a phase z: J_2k(z) falls below the accuracy / 1024 some Airy widths beyond 2k = z."""
    depth = (1.5 * math.log(1024 / accuracy)) ** (2 / 3)
    return 2 * math.ceil((0.5 * (z + depth * (z / 2) ** (1 / 3)) + 1) / 2)
