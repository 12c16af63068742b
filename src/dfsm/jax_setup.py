"""64-bit arithmetic in JAX; imported before any module makes an array."""

import jax

jax.config.update("jax_enable_x64", True)
