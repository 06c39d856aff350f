"""Band energies from the theory of disorder, without chains."""
