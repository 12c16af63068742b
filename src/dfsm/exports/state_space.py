"""Linearizations along the schedule, for python-control, MATLAB and Simulink, and as JSON."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.files import check_file, json_value, write_file, write_json
from dfsm.core.types import Array
from dfsm.core.version import __version__
from dfsm.data.channel import Channel
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.models.control_system import control_system
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.steady import operating_point, steady_state

if TYPE_CHECKING:
    import control

_EQUATIONS = "dx/dt = f0 + A (x - x0) + B (u - u0), y = y0 + C (x - x0) + D (u - u0)"
_SUFFIXES = (".mat", ".json")


@dataclass(frozen=True, eq=False)
class Linearization:
    """A model near one point: dx/dt = f0 + A (x - x0) + B (u - u0), y = y0 + C … + D ….

    Attributes
    ----------
    schedule
        Value of the scheduling signal; None for an LTI model.
    states, inputs, parameters, outputs
        x0, u0 (controls, then disturbances), p and y0, shapes ``(n,)``, in the model's units.
    derivative
        f0, which is zero to rounding at a steady state, shape ``(state,)``.
    A, B, C, D
        Exact Jacobians, ``(state, state)``, ``(state, input)``, ``(output, state)`` and
        ``(output, input)``. At a schedule point the slope in the schedule is that above it (at the
        last one, below).
    steady
        Whether nothing changes at the point; else it is the mean of the training runs there.
    message
        What the point is, and what to do about it.
    """

    schedule: float | None
    states: Array
    inputs: Array
    parameters: Array
    outputs: Array
    derivative: Array
    A: Array
    B: Array
    C: Array
    D: Array
    steady: bool
    message: str

    @property
    def stable(self) -> bool:
        """Whether all eigenvalues of A have negative real parts."""
        return bool(np.linalg.eigvals(self.A).real.max() < 0)


@dataclass(frozen=True, eq=False)
class StateSpaceModels(Sequence[Linearization]):
    """Linearizations of one model, in the order of the schedule.

    Attributes
    ----------
    points
        One for each value of the schedule.
    states, inputs, parameters, outputs
        What the vectors hold; inputs are controls, then disturbances.
    schedule
        The scheduling signal; None for an LTI model.
    state_ranges, input_ranges, parameter_ranges
        Lowest and highest values of the training data, shapes ``(n, 2)``.
    """

    points: tuple[Linearization, ...]
    states: tuple[Channel, ...]
    inputs: tuple[Channel, ...]
    parameters: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    schedule: Channel | None
    state_ranges: Array
    input_ranges: Array
    parameter_ranges: Array

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Any) -> Any:
        return self.points[index]

    def __iter__(self) -> Iterator[Linearization]:
        return iter(self.points)

    def __repr__(self) -> str:
        along = f" along {self.schedule.label}" if self.schedule else ""
        steady = sum(p.steady for p in self.points)
        return (
            f"<StateSpaceModels: {len(self)} linearizations{along}, {steady} at steady states; "
            f"{len(self.states)} states, {len(self.inputs)} inputs, {len(self.outputs)} outputs>"
        )

    def control(self) -> list[control.StateSpace]:
        """Return state-space systems of python-control with named states, inputs and outputs.

        They take and give differences from the points. For a short pulse ask `forced_response`:
        `input_output_response` of python-control 0.10.2 can step over it and return exactly 0.

        Raises
        ------
        DfsmError
            python-control is not installed, or holds no such system, see `control_system`.
        """
        groups = (self.states, self.inputs, self.outputs)
        names = [[c.name for c in group] for group in groups]
        return [control_system((p.A, p.B, p.C, p.D), *names) for p in self.points]

    def to_dict(self) -> dict[str, Any]:
        """JSON values: matrices, points, names and units."""
        values = {
            "format": 1,
            "made_by": f"dfsm {__version__}",
            "equations": _EQUATIONS,
            "schedule": None if self.schedule is None else _described([self.schedule])[0],
            "states": _described(self.states, self.state_ranges),
            "inputs": _described(self.inputs, self.input_ranges),
            "parameters": _described(self.parameters, self.parameter_ranges),
            "outputs": _described(self.outputs),
            "points": [
                {
                    "schedule": p.schedule,
                    **{key: getattr(p, name).tolist() for key, name in _ARRAYS.items()},
                    "steady": p.steady,
                    "message": p.message,
                }
                for p in self.points
            ],
        }
        return dict(json_value(values))

    def save(self, path: str | Path) -> None:
        """Write a file for MATLAB and Simulink, ``.mat``, or ``.json``.

        In ``.mat``, points are the last axis: ``ss(A, B, C, D)`` is an array of systems, and
        ``x0(:, k)`` belongs to ``A(:, :, k)``; names and units are cell arrays, and
        ``state_ranges`` and so on are the training ranges.

        Parameters
        ----------
        path
            File to write; an existing one is replaced when the new one is complete.

        Raises
        ------
        DfsmError
            Another suffix, or the file cannot be written.
        """
        check_suffix(path)
        if Path(path).suffix == ".json":
            write_json(path, self.to_dict())
            return
        from scipy.io import savemat

        content = self._matlab()
        with write_file(path) as temporary, temporary.open("wb") as file:
            savemat(file, content, appendmat=False, do_compression=True, oned_as="column")

    def _matlab(self) -> dict[str, Any]:
        stacked = {
            key: np.stack([getattr(p, name) for p in self.points], axis=-1)
            for key, name in _ARRAYS.items()
        }
        schedule = [] if self.schedule is None else [p.schedule for p in self.points]
        texts = {
            "state": self.states,
            "input": self.inputs,
            "parameter": self.parameters,
            "output": self.outputs,
            "schedule": () if self.schedule is None else (self.schedule,),
        }
        cells = {f"{k}_names": _cells(c.name for c in of) for k, of in texts.items()}
        cells |= {f"{k}_units": _cells(c.unit for c in of) for k, of in texts.items()}
        return {
            **stacked,
            **cells,
            "state_ranges": self.state_ranges,
            "input_ranges": self.input_ranges,
            "parameter_ranges": self.parameter_ranges,
            "schedule": np.array(schedule, dtype=float).reshape(1, -1),
            "steady": np.array([[p.steady for p in self.points]]),
            "messages": _cells(p.message for p in self.points),
            "equations": _EQUATIONS,
        }


# Keys in files, and the attributes of a point that they hold.
_ARRAYS = {
    **{name: name for name in "ABCD"},
    **{"x0": "states", "u0": "inputs", "p0": "parameters", "y0": "outputs", "f0": "derivative"},
}


def check_suffix(path: str | Path) -> None:
    """Refuse a file name whose suffix is neither of those that can be written, or its folder.

    Raises
    ------
    DfsmError
        Which was, or the file cannot be written there.
    """
    suffix = Path(path).suffix
    if suffix not in _SUFFIXES:
        raise DfsmError(
            f"{path} has the suffix '{suffix}', expected {' or '.join(_SUFFIXES)}: .mat for MATLAB "
            "and Simulink, .json for anything else"
        )
    check_file(path)


def to_state_space(
    model: DFSM,
    schedule: ArrayLike | None = None,
    *,
    controls: ArrayLike | None = None,
    disturbances: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> StateSpaceModels:
    """Linearize a model at its steady states along the schedule.

    Parameters
    ----------
    model
        The surrogate.
    schedule
        Values of the scheduling signal, shape ``(point,)``; None takes the operating points of the
        training data. An LTI model has one point and takes none.
    controls, disturbances, parameters
        Held there, shapes ``(n,)`` or one row per point; None takes the mean of the training runs
        at each value of the schedule.

    Returns
    -------
    StateSpaceModels
        Where there is no steady state, at that mean, with what changes there as `derivative`.

    Raises
    ------
    DfsmError
        A schedule value is outside the training range, or a group has another number of elements.

    Warns
    -----
    DfsmWarning
        Some points have no steady state.
    """
    require_model(model)
    values = _values(model, schedule)
    held = {
        group: _rows(group, given, len(model.signals.names(group)), len(values))
        for group, given in (
            ("controls", controls),
            ("disturbances", disturbances),
            ("parameters", parameters),
        )
    }
    points = tuple(
        _linearized(model, value, {group: rows[k] for group, rows in held.items()})
        for k, value in enumerate(values)
    )
    lost = [p for p in points if not p.steady]
    if lost:
        where = "" if model.schedule is None else (
            f" at {model.schedule} = {', '.join(f'{p.schedule:.4g}' for p in lost)}"
        )  # fmt: skip
        warnings.warn(
            f"no steady state{where}: linearized at the mean of the training runs there",
            DfsmWarning,
            stacklevel=2,
        )
    s = model.signals
    column = model.f.schedule
    ranges = np.stack([model.region.low, model.region.high], axis=1)
    return StateSpaceModels(
        points,
        s.states,
        (*s.controls, *s.disturbances),
        s.parameters,
        s.outputs,
        None if column is None else s.inputs[column],
        state_ranges=ranges[s.state_columns],
        input_ranges=ranges[s.order.driving_columns],
        parameter_ranges=ranges[s.order.columns("parameters")],
    )


def _values(model: DFSM, schedule: ArrayLike | None) -> list[float | None]:
    column = model.f.schedule
    if column is None:
        if schedule is not None:
            raise DfsmError("the model is LTI and has no schedule: leave the schedule values out")
        return [None]
    if schedule is not None:
        try:
            given = np.atleast_1d(np.asarray(schedule, dtype=np.float64))
        except (TypeError, ValueError):
            raise DfsmError(f"the schedule values are {schedule!r}, expected numbers") from None
        if given.ndim != 1 or not given.size:
            raise DfsmError(f"the schedule values have shape {given.shape}, expected (point,)")
        return given.tolist()
    low, high = (float(end[column]) for end in (model.region.low, model.region.high))
    return np.clip(np.asarray(model.region.grid, dtype=np.float64), low, high).tolist()


def _rows(group: str, given: ArrayLike | None, width: int, count: int) -> Sequence[Array | None]:
    """What is held at every point; None stands for the mean of the training runs."""
    if given is None:
        return [None] * count
    values = np.asarray(given, dtype=np.float64)
    if values.shape not in ((width,), (count, width)):
        raise DfsmError(
            f"{group} have shape {values.shape}, expected ({width},), or ({count}, {width}) for "
            "one row per point"
        )
    return list(np.broadcast_to(values, (count, width)))


def _linearized(model: DFSM, value: float | None, held: dict[str, Array | None]) -> Linearization:
    steady = steady_state(model, value, held["controls"], held["disturbances"], held["parameters"])
    x, u, w, p = steady.states, steady.controls, steady.disturbances, steady.parameters
    if not steady.converged:
        x = np.asarray(model.split(operating_point(model, value))[0])
    A, B, C, D = model.jacobians(x, u, w, p)
    return Linearization(
        schedule=value,
        states=x,
        inputs=np.concatenate([u, w]),
        parameters=p,
        outputs=np.asarray(model.output(x, u, w, p)),
        derivative=np.asarray(model.derivative(x, u, w, p)),
        A=A,
        B=B,
        C=C,
        D=D,
        steady=steady.converged,
        message=steady.message,
    )


def _described(channels: Sequence[Channel], ranges: Array | None = None) -> list[dict[str, Any]]:
    told = [{"name": c.name, "unit": c.unit, "role": c.role} for c in channels]
    if ranges is None:
        return told
    return [{**entry, "trained": ends.tolist()} for entry, ends in zip(told, ranges, strict=True)]


def _cells(texts: Any) -> np.ndarray:
    """A column of texts as MATLAB's cell array."""
    listed = list(texts)
    cells = np.empty((len(listed), 1), dtype=object)
    cells[:, 0] = listed
    return cells
