"""A problem as a sparse nonlinear program."""
