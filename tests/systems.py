"""Small systems with known f and g, run as black boxes, and models built from known parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.integrate import solve_ivp

from dfsm.controllers.pid import PID
from dfsm.core.host import from_host
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.corrective import GaussianUnits
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region
from dfsm.models.signals import Azimuth, SignalTable
from dfsm.refinement.growth import StabilityKept
from dfsm.refinement.rollout_error import RolloutError

Signal = Callable[[np.ndarray], np.ndarray]
Right = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class System:
    """ξ̇ = f(ξ, v), y = g(ξ, v) with v = [u, w, p]; both take one point or columns of points."""

    states: tuple[Channel, ...]
    exogenous: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    f: Right
    g: Right

    def run(
        self,
        signals: Sequence[Signal],
        x0: Sequence[float],
        time: np.ndarray,
        name: str = "run",
        wall_time: float | None = None,
    ) -> Trajectory:
        """Solve to 1e-11 and record states, inputs and outputs."""

        def drive(t: np.ndarray) -> np.ndarray:
            return np.stack([np.broadcast_to(s(t), np.shape(t)) for s in signals])

        solution = solve_ivp(
            lambda t, x: self.f(x, drive(np.asarray(t))),
            (time[0], time[-1]),
            x0,
            method="DOP853",
            t_eval=time,
            rtol=1e-11,
            atol=1e-11,
        )
        assert solution.success
        x, v = solution.y, drive(time)
        values = np.concatenate([x, v, self.g(x, v)]).T
        channels = (*self.states, *self.exogenous, *self.outputs)
        return Trajectory(
            time, values, channels, name=name, source=f"runs/{name}.csv", wall_time=wall_time
        )

    def many(
        self,
        count: int,
        levels: Sequence[tuple[float, float]],
        time: np.ndarray,
        seed: int = 0,
        speed: float = 1.0,
        spread: float = 0.5,
    ) -> list[Trajectory]:
        """Runs with random smooth inputs of given (mean, amplitude) from random initial states."""
        runs = []
        for i in range(count):
            rng = np.random.default_rng([seed, i])
            signals = [wander(rng, mean, size, speed) for mean, size in levels]
            x0 = rng.normal(0, spread, len(self.states))
            runs.append(self.run(signals, list(x0), time, f"run{seed}_{i}", wall_time=100.0))
        return runs


def wander(rng: np.random.Generator, mean: float, size: float, speed: float = 1.0) -> Signal:
    """Sum of eight sines of random frequency and phase: smooth, and known at every time."""
    frequencies = speed * rng.uniform(0.1, 3.0, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    amplitudes = size * rng.dirichlet(np.ones(8))

    def signal(t: np.ndarray) -> np.ndarray:
        angle = np.multiply.outer(np.asarray(t), frequencies) + phases
        return mean + np.sin(angle) @ amplitudes

    return signal


def constant(value: float) -> Signal:
    """Signal that never changes."""
    return lambda t: np.full(np.shape(t), value)


Q, V = Channel("q", "m"), Channel("v", "m/s")
U, W, Y = Channel("u", "N"), Channel("w", "m/s"), Channel("y", "kN")

# q̈ = -4 q - 0.6 q̇ + 2 u + 0.5 w,  y = 3 q - q̇ + 0.2 u + 10
OSCILLATOR = System(
    (Q, V),
    (U, W),
    (Y,),
    f=lambda x, v: np.stack([x[1], -4 * x[0] - 0.6 * x[1] + 2 * v[0] + 0.5 * v[1]]),
    g=lambda x, v: np.stack([3 * x[0] - x[1] + 0.2 * v[0] + 10]),
)
OSCILLATOR_A = np.array([[0, 1], [-4, -0.6]])
OSCILLATOR_B = np.array([[0, 0], [2, 0.5]])

# A hardening spring: only q̈ and y are nonlinear; z = q + v is a linear output.
DUFFING = System(
    (Q, V),
    (U, W),
    (Y, Channel("z", "m")),
    f=lambda x, v: np.stack([x[1], -2 * x[0] - 3 * x[0] ** 3 - 0.8 * x[1] + 2 * v[0] + 0.5 * v[1]]),
    g=lambda x, v: np.stack([x[0] ** 2 + 0.1 * v[0], x[0] + x[1]]),
)

# Coefficients linear in w: between two windows' centres the interpolation is exact.
SCHEDULED = System(
    (Q, V),
    (U, W),
    (Y,),
    f=lambda x, v: np.stack(
        [x[1], -(1 + 0.3 * v[1]) * x[0] - (0.5 + 0.05 * v[1]) * x[1] + (3 - 0.1 * v[1]) * v[0]]
    ),
    g=lambda x, v: np.stack([(1 + 0.5 * v[1]) * x[0]]),
)

# The stiffness is a plant parameter, constant within a run.
SPRING = System(
    (Q, V),
    (U, Channel("k", "N/m")),
    (Y,),
    f=lambda x, v: np.stack([x[1], -v[1] * x[0] - 0.8 * x[1] + 2 * v[0]]),
    g=lambda x, v: np.stack([v[1] * x[0]]),
)


def linear_model(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray | None = None,
    D: np.ndarray | None = None,
    *,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    order: Literal[1, 2] = 1,
    corrective: GaussianUnits | None = None,
    span: float = 10.0,
    azimuth: Azimuth | None = None,
) -> DFSM:
    """ξ̇ = A ξ + B u (+ e in the last row), y = C ξ + D u: a model whose every part is known.

    With ``order=2`` the second half of the states are the rates of the first.
    """
    n, m = B.shape
    names = names or [f"x{i}" for i in range(n)]
    states = tuple(
        Channel(a, b, role="state") for a, b in zip(names, units or ["m"] * n, strict=True)
    )
    controls = tuple(Channel(f"u{i}", "N", role="control") for i in range(m))
    p = 0 if C is None else len(C)
    specs = tuple(StateSpec(name=c.name, order=order) for c in states[: n // order])
    L = np.concatenate([B, A], axis=1)
    g = None
    if C is not None:
        D = np.zeros((p, m)) if D is None else D
        G = np.concatenate([D, C], axis=1)
        if azimuth is not None:
            G = np.concatenate([G, np.tile([1.0, 0.0], (p, 1))], axis=1)
        g = _linear(G)
    ends = np.full(n + m, span)
    region = (-ends, ends, 0 * ends, ends / 3, np.zeros(1), np.zeros((1, n + m)))
    return DFSM(
        f=_linear(L),
        e=corrective,
        g=g,
        e_g=None,
        region=Region(*map(from_host, region)),
        corrected=(n - 1,) if corrective is not None else (),
        corrected_outputs=(),
        signals=SignalTable(
            states=states,
            controls=controls,
            disturbances=(),
            parameters=(),
            outputs=tuple(Channel(f"y{i}", "kN", role="output") for i in range(p)),
            specs=specs,
            derivatives=DerivativeSettings(),
            azimuth=azimuth,
        ),
    )


def _linear(L: np.ndarray) -> LinearModel:
    """Constant coefficients ``(target, input)`` and no offset."""
    return LinearModel(*map(from_host, (np.zeros(1), L[None], np.zeros((1, len(L))))), None)


def driving_run(
    model: DFSM, time: np.ndarray, inputs: np.ndarray, states: np.ndarray, name: str = "run"
) -> Trajectory:
    """A recorded run for a model: measured states and controls on a mesh."""
    measured = [c for c in model.signals.states if c.name in {s.name for s in model.signals.specs}]
    return Trajectory(
        time,
        np.concatenate([states, inputs], axis=1),
        (*measured, *model.signals.controls),
        name=name,
        source=f"runs/{name}.csv",
    )


def cost_slopes(
    problem: RolloutError | StabilityKept, at: np.ndarray, eps: float = 1e-6
) -> list[float]:
    """Central differences of a cost of refinement in every parameter."""
    eps = 1e-6
    steps = eps * np.eye(at.size)
    return [(problem.cost(at + d) - problem.cost(at - d)) / (2 * eps) for d in steps]


def law(kp: float) -> PID:
    """PI with an integral gain of 0.1, from a position `q` in m to a force `u0` in N."""
    return PID(
        kp=kp,
        ki=0.1,
        setpoint=0.2,
        measurements=["q"],
        measurement_units=["m"],
        commands=["u0"],
        command_units=["N"],
        interval=0.1,
    )
