"""Derivative function surrogate models from time-domain simulations."""

__version__ = "0.1.0"
