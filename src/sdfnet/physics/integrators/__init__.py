"""Time integrators, one a file, all over the free degrees of freedom and over many load cases as columns."""
