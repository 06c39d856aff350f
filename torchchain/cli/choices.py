"""The names that help lists, spelled out so that it answers without torch; a test compares them with the registries."""

KINDS = ("normal", "uniform", "binary", "lognormal", "gamma")
EXCITATIONS = ("impulse", "standing_wave")
BOUNDARIES = ("periodic", "fixed")
LATTICE_BOUNDARIES = ("periodic", "fixed", "free")
ARRANGEMENTS = ("random", "alternating", "blocks")
LATTICES = ("chain", "square", "triangular", "cubic", "fcc")
CONTACTS = ("linear", "hertz", "auto")
DEFINITIONS = ("site", "bond")
OBSERVABLES = (
    "band_energy", "center", "displacement", "dissipated", "energy", "front", "kicked_band_energy",
    "long_time_band_energy", "openings",
    "radial_profile", "radius", "source_energy", "species_energy", "spread", "total_energy", "wavenumber_energy", "width",
)  # fmt: skip
METHODS = (
    "modes", "tridiagonal", "chebyshev", "verlet", "symplectic4", "damped", "dopri5", "dopri8", "bosh3",
    "adaptive_heun", "fehlberg2", "lsoda", "midpoint", "heun2", "heun3", "rk4", "explicit_adams", "implicit_adams",
)  # fmt: skip
SOLVERS = (
    "expm", "dopri8", "dopri5", "bosh3", "fehlberg2", "adaptive_heun", "euler", "midpoint", "heun2", "heun3", "rk4",
    "explicit_adams", "implicit_adams", "fixed_adams", "scipy_solver",
)  # fmt: skip
FITS = ("analytic", "linear", "nonlinear", "adam", "derivation", "correction", "ringing", "logistic", "projection")
MODELS = (
    "paper", "exact_psi", "basis_matrix", "swing_in", "theory", "corrected_theory", "ringing_theory", "compact", "memory",
)  # fmt: skip
FORMATS = ("lammps", "mercury", "xyz", "netcdf")
UNITS = ("file", "mass", "linear", "hertz")
FIGURES = ("png", "pdf", "svg")
