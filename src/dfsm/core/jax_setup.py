"""How JAX is set up: 64-bit arithmetic, small loops compiled in one piece, compiled code kept.

These are settings of the process, made when the first part of dfsm that computes with JAX is
imported; ``import dfsm`` alone, reading and writing of files change nothing.

Derivatives of noisy records, steps of a solver and tolerances of 1e-8 need 64 bits. JAX decides
what a number is while it traces, so that a model called inside a user's own `jax.jit` is computed
with what is set there: a switch around dfsm's own calls would give two answers of one model.
Arrays with an explicit 32-bit type keep it.

XLA's CPU compiler splits the body of a loop into pieces that it calls one after another, which
costs more than the arithmetic of a small model. Bodies that touch less memory than `_SMALL_LOOP`
bytes are compiled into one function instead: a rollout takes about half the time. XLA reads
`XLA_FLAGS` once, when it is first asked to compile; a process that used JAX before has its
rollouts a little later. Flags of the user's own are not touched, and the environment is as before
once XLA has read them: programs that are started from here are none of our business, and workers
of our own set themselves up.
"""

import os
import warnings

import jax
from jaxlib import xla_client

from dfsm.core.compile_cache import keep_compiled
from dfsm.errors import DfsmWarning

_SMALL_LOOP = 2_000_000
_OPTION = "xla_cpu_small_while_loop_byte_threshold"
# A second occurrence would replace the one in the user's flags.
_EXTRA = "--xla_backend_extra_options"
# What JAX takes for no.
_FALSE = ("n", "no", "f", "false", "off", "0")


def _use_64_bits() -> None:
    if os.environ.get("JAX_ENABLE_X64", "").strip().lower() in _FALSE:
        warnings.warn(
            "JAX_ENABLE_X64 asks for 32 bits and dfsm computes with 64: the whole process is "
            "switched to 64 bits, give your own arrays a dtype where they should keep 32",
            DfsmWarning,
            stacklevel=2,
        )
    jax.config.update("jax_enable_x64", True)


def _keep_small_loops_whole() -> None:
    before = os.environ.get("XLA_FLAGS")
    if before and (_EXTRA in before or _OPTION in before):
        return
    os.environ["XLA_FLAGS"] = f"{before or ''} {_EXTRA}={_OPTION}={_SMALL_LOOP}".strip()
    try:
        # Makes XLA read its flags, without a device. What this returns does not outlive `options`.
        options = xla_client.CompileOptions()
        _ = options.executable_build_options.debug_options
    finally:
        if before is None:
            del os.environ["XLA_FLAGS"]
        else:
            os.environ["XLA_FLAGS"] = before


_use_64_bits()
_keep_small_loops_whole()
keep_compiled()
