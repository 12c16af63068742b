"""What sets the controls of a turbine: one interface, ROSCO in JAX, Bladed-style libraries."""
