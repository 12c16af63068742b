"""Inputs between nodes and samples: held controls, and disturbances as they were recorded.

A disturbance that is held jumps at its samples, and a control that is held at edges of the mesh.
Only a scheme whose intervals share no slope, Radau's, can follow a jump: there the value before it
belongs to the interval that ends with it.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from dfsm.control.mesh.grid import Grid
from dfsm.control.names import Plant
from dfsm.core.types import Array
from dfsm.data.between import Between, Chosen, polynomials, resolved
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, DfsmWarning

# A node is before a jump that is no further from it than this share of the horizon.
_BESIDE = 1e-9


def kinds_of(
    chosen: Chosen, plant: Plant, own: Sequence[Between], name: str
) -> tuple[Between, ...]:
    """What controls and disturbances, in this order, do between nodes and samples.

    Parameters
    ----------
    chosen
        What the problem says.
    plant
        Names its controls and disturbances.
    own
        What the model's runs say, empty for lines. Of controls it says what was recorded, not what
        is to be chosen.
    name
        Of the problem.

    Raises
    ------
    DfsmError
        Unknown names or kinds, or some controls that are held beside others that are not.
    """
    controls, disturbances = plant.names("controls"), plant.names("disturbances")
    names = (*controls, *disturbances)
    kinds = list(resolved(chosen, names, own))
    named = names if isinstance(chosen, str) else (chosen or {})
    first: list[Between] = [kinds[i] if n in named else "linear" for i, n in enumerate(controls)]
    held = [n for n, kind in zip(controls, first, strict=True) if kind == "hold"]
    if held and len(held) < len(controls):
        rest = ", ".join(n for n in controls if n not in held)
        raise DfsmError(
            f"{name}: inputs hold {', '.join(held)} and not {rest}: all controls are held over the "
            "same intervals, or none is"
        )
    return (*first, *kinds[len(controls) :])


def require_followed(grid: Grid, plant: Plant, kinds: Sequence[Between], timed: bool) -> None:
    """Refuse a method that cannot follow what inputs do.

    Parameters
    ----------
    grid
        Of the method.
    plant, kinds
        Controls and disturbances, and what they do, see `kinds_of`.
    timed
        Whether the last time is free, so that nodes move along the disturbances.

    Raises
    ------
    DfsmError
        An input is held, and the scheme is not Radau's, or a disturbance is no line and the last
        time is free.
    """
    controls = plant.names("controls")
    names = (*controls, *plant.names("disturbances"))
    held = [n for n, kind in zip(names, kinds, strict=True) if kind == "hold"]
    if held and grid.kind != "radau":
        raise DfsmError(
            f"'{held[0]}' is held between {'nodes' if held[0] in controls else 'samples'}, and "
            "neighbouring intervals of this method share what happens where it jumps: take the "
            f"scheme radau, or set inputs: {{{held[0]}: linear}}"
        )
    moving = [
        n for n, kind in zip(names, kinds, strict=True) if kind != "linear" and n not in controls
    ]
    if timed and moving:
        raise DfsmError(
            f"'{moving[0]}' does not follow lines between samples, which a free last time needs: "
            f"fix the last time, or set inputs: {{{moving[0]}: linear}}"
        )


def tell_of_held(plant: Plant, own: Sequence[Between], chosen: Chosen) -> None:
    """Warn where controls were held in the runs of a model and are chosen as curves.

    Parameters
    ----------
    plant
        Names the controls.
    own, chosen
        What the model's runs, and what the problem, say of them.

    Warns
    -----
    DfsmWarning
        Names the first of them.
    """
    if isinstance(chosen, str):
        return
    controls = plant.names("controls")
    curved = [
        n
        for n, kind in zip(controls, own, strict=False)
        if kind == "hold" and n not in (chosen or {})
    ]
    if curved:
        warnings.warn(
            f"'{curved[0]}' was held between samples in the runs of the model and is chosen as a "
            f"curve here: set inputs: {{{curved[0]}: hold}} with scheme radau if it will be held "
            f"when it is used, or inputs: {{{curved[0]}: linear}} if not",
            DfsmWarning,
            stacklevel=3,
        )


def disturbances_at(
    run: Trajectory, names: Sequence[str], kinds: Sequence[Between], time: Array, span: float
) -> Array:
    """Disturbances at nodes, those that jump there as they were before.

    Parameters
    ----------
    run, names
        Where they are recorded.
    kinds
        What each does between samples.
    time
        In s, shape ``(time,)``.
    span
        Of the horizon in s.

    Returns
    -------
    ndarray
        Shape ``(time, disturbance)``.
    """
    w = np.zeros((len(time), len(names)))
    for i, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        if kind == "linear":
            w[:, i] = np.interp(time, run.time, run[name])
            continue
        d, c, b, a = polynomials(run.time, run[name][:, None], (kind,))[:, :, 0]
        t = np.clip(time, run.time[0], run.time[-1])
        if kind == "hold":
            # The value at the first time is that of the sample there: nothing ends with it.
            t = np.maximum(t - _BESIDE * span, t.min())
        k = np.clip(np.searchsorted(run.time, t, side="right") - 1, 0, len(run.time) - 2)
        s = t - run.time[k]
        w[:, i] = a[k] + s * (b[k] + s * (c[k] + s * d[k]))
    return w
