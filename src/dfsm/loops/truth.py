"""What a surrogate is confirmed by: a simulator behind one function, or a folder of flown runs.

A truth has a method ``run(case) -> Trajectory``: the run of a case under its controller, with the
channels that are measured, over the time that is scored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.discon import Discon, write_discon
from dfsm.core.host import from_host
from dfsm.core.settings import require_kind
from dfsm.data.apart import require_apart
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.readers import read
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region
from dfsm.models.signals import SignalTable
from dfsm.models.terms.form import Term
from dfsm.models.terms.terms import Terms
from dfsm.simulation.closed_loop import LoopStatus, closed_loop
from dfsm.simulation.loop_cases import ClosedLoopSettings
from dfsm.simulators import ODESystem

# Where a true system counts as unstable: in the units of its states.
_ENDLESS = 1e9


class TruthEndedError(DfsmError):
    """The true system did not come to its end under a controller."""


@dataclass(frozen=True)
class TruthCase:
    """One run to fly.

    Attributes
    ----------
    flight
        Number of the evaluation, from 1.
    run
        What drives it, and where it starts.
    controller
        To fly it with.
    values
        Its tuned parameters by name.
    discon
        The same as a DISCON.IN; None for other controllers.
    """

    flight: int
    run: Trajectory
    controller: Any
    values: Mapping[str, float]
    discon: Discon | None = None


class Truth(Protocol):
    """A high-fidelity simulator."""

    def run(self, case: TruthCase) -> Trajectory:
        """The run of a case, from its start on.

        Parameters
        ----------
        case
            What to fly.

        Raises
        ------
        TruthEndedError
            The system did not come to its end.
        DfsmError
            There is no such run.
        """
        ...


class SystemTruth:
    """A truth that is an ordinary differential equation.

    Parameters
    ----------
    system
        Written with jax.numpy. Its states start where the runs have them.
    measurements, settings
        As for `closed_loop`; by default the whole run is flown.
    """

    def __init__(
        self,
        system: ODESystem,
        *,
        measurements: Mapping[str, str] | None = None,
        settings: ClosedLoopSettings | None = None,
    ) -> None:
        require_kind("system", system, ODESystem, "a dfsm.ODESystem")
        require_kind("settings", settings, ClosedLoopSettings | None, "dfsm.ClosedLoopSettings(…)")
        self.model = exact_model(system)
        self.measurements = measurements
        self.settings = settings or ClosedLoopSettings(start_up=0.0)
        self.flights = 0

    def run(self, case: TruthCase) -> Trajectory:
        """The run of a case; see `Truth`."""
        self.flights += 1
        with hushed():
            done = closed_loop(
                self.model,
                case.run,
                case.controller,
                measurements=self.measurements,
                settings=self.settings,
            )
        if done.status is not LoopStatus.COMPLETED:
            raise TruthEndedError(f"{case.run.name}: {done.message}")
        return done.trajectory


class FlownRuns:
    """A truth that somebody flies elsewhere: a folder with one folder per evaluation.

    In ``folder/flight_1`` the DISCON.IN to fly is written; the runs belong beside it, each under
    the name of the run that it repeats (``case_12mps_s01.outb``).

    Parameters
    ----------
    folder
        Made if need be.
    """

    def __init__(self, folder: str | Path) -> None:
        require_kind("folder", folder, str | PathLike, "the path of a folder")
        self.folder = Path(folder)

    def check(self, runs: Sequence[Trajectory]) -> None:
        """Refuse runs of which two have one name: what is flown of one would stand for both.

        Raises
        ------
        DfsmError
            Names both.
        """
        targets = [self.folder / "flight_1" / run.name for run in runs]
        require_apart(runs, targets, "be looked for as", "rename one of them")

    def prepare(self, cases: Sequence[TruthCase]) -> None:
        """Write what is to be flown.

        Raises
        ------
        DfsmError
            Runs are missing: names them, and says where they belong. Or two have one name.
        """
        self.check([case.run for case in cases])
        place = self.folder / f"flight_{cases[0].flight}"
        place.mkdir(parents=True, exist_ok=True)
        if cases[0].discon is not None:
            write_discon(cases[0].discon, place / "DISCON.IN")
        lost = [c.run.name for c in cases if not self._files(place, c)]
        if lost:
            told = ", ".join(f"{k} = {v:.6g}" for k, v in cases[0].values.items())
            law = "these gains" if cases[0].discon is None else "its DISCON.IN"
            raise DfsmError(
                f"{place} lacks {len(lost)} of {len(cases)} runs ({', '.join(lost[:4])}"
                f"{', …' if len(lost) > 4 else ''}): fly them with {law} ({told}), put "
                "them there under these names, and give the same command again"
            )

    def run(self, case: TruthCase) -> Trajectory:
        """The run of a case; see `Truth`."""
        place = self.folder / f"flight_{case.flight}"
        found = self._files(place, case)
        if not found:
            raise DfsmError(f"{place} has no run {case.run.name}: fly it, and put it there")
        if len(found) > 1:
            names = " and ".join(p.name for p in found[:2])
            raise DfsmError(f"{place} has {names} for one run: leave one of them there")
        return read(found[0])

    def _files(self, place: Path, case: TruthCase) -> list[Path]:
        files = sorted(place.iterdir()) if place.is_dir() else []
        return [p for p in files if p.stem == case.run.name and p.is_file()]


# -- an equation as a model ---------------------------------------------------------------------


class _RightSide(Term):
    """f and g of a system as values of one known term."""

    kind = "system"
    system: ODESystem = eqx.field(static=True)

    def values(self, signals: jax.Array) -> jax.Array:
        s = self.system
        ends = np.cumsum([len(s.controls), len(s.disturbances), len(s.states)])
        u, w, x, p = jnp.split(signals, ends)
        parts = [s.f(x, u, w, p)]
        if s.g is not None:
            parts.append(s.g(x, u, w, p))
        return jnp.concatenate([jnp.asarray(part, dtype=float) for part in parts])

    def structure(self) -> dict[str, Any]:
        raise DfsmError("a model made of a system's own equations cannot be saved")

    def arrays(self) -> dict[str, jax.Array]:
        return {}

    @classmethod
    def restored(
        cls,
        columns: tuple[int, ...],  # noqa: ARG003
        channels: tuple[Channel, ...],  # noqa: ARG003
        arrays: Mapping[str, jax.Array],  # noqa: ARG003
        structure: Mapping[str, Any],  # noqa: ARG003
    ) -> _RightSide:
        raise DfsmError("a model made of a system's own equations cannot be saved")


def exact_model(system: ODESystem) -> DFSM:
    """A system's own equations in the form of a model, for closed loops on it.

    Raises
    ------
    DfsmError
        It is not written with jax.numpy.
    """
    if system.backend != "jax":
        raise DfsmError(
            f"{system.name} has the backend {system.backend}: closed loops need f and g that JAX "
            "can follow; or write a truth with a method run(case)"
        )
    driving = (*system.controls, *system.disturbances)
    inputs = (*driving, *system.states, *system.parameters)
    n, m, k = len(inputs), len(system.states), len(system.outputs)
    values = (
        *(Channel(f"{c.name}'", c.unit) for c in system.states),
        *(Channel(f"{c.name}'", c.unit) for c in system.outputs),
    )
    term = _RightSide(columns=tuple(range(n)), channels=values, system=system)
    chosen = np.concatenate([np.zeros((m + k, n)), np.eye(m + k)], axis=1)
    ends = np.full(n, _ENDLESS)
    low, high, none = map(from_host, (-ends, ends, 0 * ends))

    def rows(part: slice, count: int) -> LinearModel:
        grid, L, b = map(from_host, (np.zeros(1), chosen[None, part], np.zeros((1, count))))
        return LinearModel(grid, L, b, None)

    return DFSM(
        f=rows(slice(0, m), m),
        e=None,
        g=rows(slice(m, m + k), k) if k else None,
        e_g=None,
        region=Region(low, high, none, high, from_host(np.zeros(1)), from_host(np.zeros((1, n)))),
        corrected=(),
        corrected_outputs=(),
        signals=SignalTable(
            states=system.states,
            controls=system.controls,
            disturbances=system.disturbances,
            parameters=system.parameters,
            outputs=system.outputs,
            specs=tuple(StateSpec(name=c.name) for c in system.states),
            derivatives=DerivativeSettings(),
        ),
        terms=Terms((term,), from_host(np.zeros(m + k)), from_host(np.ones(m + k))),
    )
