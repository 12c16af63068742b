"""A model with a part of every kind, made by hand, and where exports are compared with it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.features import Feature, with_features
from dfsm.data.readers.rotor_table import RotorTable
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.corrective import GaussianUnits, Perceptron, Polynomial
from dfsm.models.corrective.polynomial import monomials
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.passing import Passing
from dfsm.models.region import Region
from dfsm.models.signals import Azimuth, SignalTable
from dfsm.models.terms import Function, Product, QuadraticDrag, Rotor, Terms
from systems import linear_model

RINGS = (20.0, 40.0)
AZIMUTH = Azimuth(speed="RotSpeed", angle="Azimuth", rings=RINGS, orders={1: (0, 1), 3: (2, 3)})
TABLE = jnp.array([0.0, 1.0, 4.0, 9.0, 16.0])


A = np.array([[-0.4, 1.0, 0.2], [-0.8, -0.5, 0.3], [0.1, -0.2, -0.7]])
B = np.array([[0.3, 0.1], [0.5, -0.2], [0.0, 0.4]])


def friction(speed, heave):
    """A user's function with a table, a branch and a power."""
    table = jnp.interp(heave, jnp.arange(-2.0, 3.0), TABLE)
    kind = (speed * 4).astype(int) % 3
    steps = jnp.array([1.0, 2.0, 4.0])[kind]
    return 0.1 * table + jnp.where(speed > 7, jnp.log1p(speed**2), 0.3 * speed) + 0.01 * steps


def rotor_table() -> RotorTable:
    ratio, pitch = np.linspace(2, 14, 13), np.linspace(-2, 20, 12)
    shape = np.exp(-(((ratio[:, None] - 8) / 4) ** 2)) * np.exp(-((pitch / 12) ** 2))
    cp = 0.48 * shape - 0.05 * (ratio[:, None] / 14) ** 2
    ct = 0.05 + 0.8 * np.exp(-((pitch / 15) ** 2)) * (ratio[:, None] / 14)
    return RotorTable(pitch, ratio, cp, ct, cp / ratio[:, None])


@cache
def whole() -> DFSM:
    """LPV, terms of all kinds, both correctives, latent states, a parameter, blades in a field."""
    rng = np.random.default_rng(5)
    latents = (Channel("latent1", "-"), Channel("latent2", "-"))
    signals = SignalTable(
        states=(
            Channel("RotSpeed", "rpm"),
            Channel("heave <z>", "m"),
            Channel("heave <z>_dot", "m/s"),
            *latents,
        ),
        controls=(Channel("Gen Torque", "kN m"), Channel("BldPitch1", "deg")),
        disturbances=(Channel("RotWind", "m/s"), Channel("eta_dot", "m/s")),
        parameters=(Channel("mass", "t"),),
        outputs=(Channel('2"P', "kW"), Channel("TwrBsMyt", "kN m"), Channel("Yaw", "deg")),
        specs=(StateSpec(name="RotSpeed"), StateSpec(name="heave <z>", order=2)),
        derivatives=DerivativeSettings(),
        azimuth=AZIMUTH,
        latents=latents,
        features=(Feature(source="eta", kind="rate"),),
        field=tuple(Channel(name, "m/s") for name in AZIMUTH.field),
        between=("hold", "linear", "linear", "linear"),
    )
    channels = signals.inputs
    columns = {c.name: i for i, c in enumerate(channels)}
    by_name = {c.name: c for c in channels}
    settings = (
        Rotor(
            table=rotor_table(),
            radius=60.0,
            wind="RotWind",
            speed="RotSpeed",
            pitch="BldPitch1",
            uncertainty=0.1,
        ),
        Product(factors=("RotSpeed", "heave <z>", "heave <z>")),
        QuadraticDrag(velocity="heave <z>_dot", against="eta_dot"),
        Function(name="friction", function=friction, inputs=("RotSpeed", "heave <z>")),
    )
    parts = tuple(s.term(by_name, columns, dict.fromkeys(columns, 1.0)) for s in settings)
    # A table that is uncertain, and by how much: what refinement on rollouts leaves.
    parts = (parts[0].moved([jnp.asarray(rng.normal(size=(2, 6)))]), *parts[1:])
    terms = Terms(parts, jnp.zeros(5), jnp.ones(5))
    #                 torque pitch  wind eta_dot speed heave rate latents     mass
    low = np.array([-5.0, 0.0, 4.0, -1.0, 4.0, -2.0, -1.0, -1.0, -1.0, 1.0])
    high = np.array([5.0, 15.0, 20.0, 1.0, 12.0, 2.0, 1.0, 1.0, 1.0, 2.0])
    size, points = (high - low) / 2, np.array([5.0, 9.0, 12.0, 19.0])
    f = 0.1 * rng.normal(size=(4, 5, 15)) / np.concatenate([size, [900, 9000, 40, 2, 2]])
    f[:, 1:] = 0.0
    f[:, 0, 4] -= 0.3
    f[:, 1, 6] = 1.0
    f[:, 2, [3, 5, 6, 12, 13]] = [0.2, -1.0, -0.4, -0.05, -0.1]
    f[:, 3:, 7:9] = [[-0.5, 0.8], [-0.8, -0.5]]
    f[:, 3, 2] = 0.05
    g = rng.normal(size=(4, 3, 15)) / np.concatenate([size, [900, 9000, 40, 2, 2]])
    middle = jnp.asarray((low + high) / 2)
    return DFSM(
        f=LinearModel(
            jnp.asarray(points),
            jnp.asarray(f),
            jnp.asarray(rng.normal(size=(4, 5)) * [2, 0, 0, 0, 0]),
            2,
        ),
        e=GaussianUnits(
            middle,
            jnp.asarray(2 * size).at[9].set(jnp.inf),
            jnp.asarray(rng.normal(size=(10, 12))),
            jnp.asarray(0.3 * rng.normal(size=(2, 12))),
            jnp.zeros(2),
        ),
        g=LinearModel(jnp.asarray(points[:3]), jnp.asarray(g[:3]), jnp.zeros((3, 3)), 2),
        e_g=Perceptron(
            middle,
            jnp.asarray(size),
            (jnp.asarray(rng.normal(size=(6, 10))), jnp.asarray(rng.normal(size=(1, 6)))),
            (jnp.zeros(6), jnp.ones(1)),
        ),
        region=Region(
            jnp.asarray(low),
            jnp.asarray(high),
            middle,
            jnp.asarray(size),
            jnp.asarray(points),
            jnp.tile(middle, (4, 1)),
            schedule=2,
        ),
        corrected=(0, 2),
        corrected_outputs=(1,),
        signals=signals,
        terms=terms,
        passing=Passing(
            jnp.asarray(rng.normal(size=(3, 3, 20))), jnp.asarray(8.0), jnp.array([6.0, 16.0]), 4
        ),
    )


def hidden(kind: str) -> DFSM:
    """One measured and two hidden states, all rows corrected, made for steps of half a sample."""
    rng = np.random.default_rng(7)
    model = linear_model(A, B, np.array([[2.0, 0.0, 0.0]]), names=["y", "hidden1", "hidden2"])
    signals = replace(
        model.signals,
        specs=model.signals.specs[:1],
        latents=model.signals.states[1:],
        between=("hold", "cubic"),
        startup=5.0,
        step=0.1,
    )
    shift, scale = jnp.asarray(rng.normal(size=5)), jnp.asarray(rng.uniform(1, 2, 5))
    factors = monomials(5, 3)
    e = (
        Polynomial(shift, scale, jnp.asarray(0.02 * rng.normal(size=(3, len(factors)))), factors)
        if kind == "polynomial"
        else Perceptron(
            shift,
            scale,
            (jnp.asarray(rng.normal(size=(6, 5))), jnp.asarray(0.05 * rng.normal(size=(3, 6)))),
            (jnp.asarray(rng.normal(size=6)), jnp.zeros(3)),
        )
    )
    return replace(model, e=e, corrected=(0, 1, 2), signals=signals)


def points(model: DFSM, count: int = 1000) -> list[Array]:
    """States, controls, disturbances and parameters inside and outside the training data.

    Half of them up to twice the range; a few exactly on the schedule's points, just beyond its ends
    and a cell beyond them.
    """
    rng = np.random.default_rng(1)
    low, high = np.asarray(model.region.low), np.asarray(model.region.high)
    inputs = (low + high) / 2 + (high - low) / 2 * rng.uniform(-1, 1, (count, len(low)))
    inputs[::2] += (high - low) / 2 * rng.uniform(-1, 1, (len(inputs[::2]), len(low)))
    if model.f.schedule is not None:
        grid = np.asarray(model.f.grid)
        cells = np.diff(grid)[[0, -1]]
        at = [*grid, grid[0] - cells[0], grid[-1] + cells[1], grid[0] - 1e-9, grid[-1] + 1e-9]
        inputs[: len(at), model.f.schedule] = at
    return [np.asarray(group) for group in model.signals.order.split(jnp.asarray(inputs))]


def turning(model: DFSM, count: int = 1000) -> tuple[Array, Array]:
    """Azimuths in rad and harmonics of the wind field."""
    rng = np.random.default_rng(2)
    return rng.uniform(-9, 9, count), rng.normal(size=(count, len(model.signals.field)))


def drive(model: DFSM, duration: float = 600.0, step: float = 0.25) -> Trajectory:
    """Inputs that wander through the training range and somewhat beyond it."""
    s, time = model.signals, np.arange(0, duration + step / 2, step)
    rng = np.random.default_rng(3)
    names = [*s.exogenous, *s.names("field")]
    units = [c.unit for c in (*s.controls, *s.disturbances, *s.parameters, *s.field)]
    low, high = np.asarray(model.region.low), np.asarray(model.region.high)
    columns = []
    for name in s.exogenous:
        k = s.order.column(name)
        wave = np.sin(rng.uniform(0.02, 0.4) * time + rng.uniform(0, 6))
        moving = name not in s.names("parameters")
        columns.append((low[k] + high[k]) / 2 + 0.6 * (high[k] - low[k]) * wave * moving)
    columns += [np.sin(rng.uniform(0.1, 0.5) * time) for _ in s.field]
    channels = [Channel(n, u) for n, u in zip(names, units, strict=True)]
    if s.azimuth is not None and s.azimuth.angle is not None:
        channels.append(Channel(s.azimuth.angle, "deg"))
        columns.append(0 * time + 30.0)
    for feature in s.features:
        channels.append(Channel(feature.source, "m"))
        columns.append(np.sin(0.3 * time))
    run = Trajectory(time, np.stack(columns, axis=1), tuple(channels), name="drive")
    return with_features(run, s.features)


def close(ours: Array, reference: Array, tolerance: float = 1e-11) -> None:
    """Equal up to rounding, seen against the size of each column."""
    size = np.abs(reference).max(axis=0) + 1e-30
    assert ours.shape == reference.shape
    assert np.isfinite(reference).all()
    assert np.abs((ours - reference) / size).max() < tolerance
