"""How JAX is set up, before any array is made: 64-bit arithmetic, small loops in one piece.

XLA's CPU compiler splits the body of a loop into pieces that it calls one after another, which
costs more than the arithmetic of a small model. Bodies that touch less memory than `_SMALL_LOOP`
bytes are compiled into one function instead: a rollout takes about half the time. XLA reads the
option when it first compiles; a process that used JAX before has its rollouts a little later.
"""

import os

import jax

_SMALL_LOOP = 2_000_000
_OPTION = "xla_cpu_small_while_loop_byte_threshold"

jax.config.update("jax_enable_x64", True)

_flags = os.environ.get("XLA_FLAGS", "")
if _OPTION not in _flags:
    os.environ["XLA_FLAGS"] = (
        f"{_flags} --xla_backend_extra_options={_OPTION}={_SMALL_LOOP}".strip()
    )
