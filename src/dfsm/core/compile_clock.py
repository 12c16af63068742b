"""How much of the time went into compiling."""

from __future__ import annotations

from collections.abc import Callable

import jax.monitoring

# What JAX tells of every program: translated, and compiled or read from the cache. Tracing is not
# counted, which it tells once for every function within another.
_PARTS = (
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


def compile_clock() -> Callable[[], tuple[float, int]]:
    """Start to count.

    Returns
    -------
    Callable
        Tells the seconds since, and the number of programs.
    """
    told: list[tuple[str, float]] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event in _PARTS:
            told.append((event, duration_secs))

    jax.monitoring.register_event_duration_secs_listener(listen)
    return lambda: (sum(s for _, s in told), sum(event == _PARTS[1] for event, _ in told))
