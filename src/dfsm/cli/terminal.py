"""What all commands of the terminal share: common options, progress, what is printed."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dfsm.core.progress import show_progress
from dfsm.errors import DfsmError, hushed, printable

if TYPE_CHECKING:
    from dfsm.data.trajectory import Trajectory
    from dfsm.models.dfsm import DFSM
    from dfsm.simulation.simulate import Simulation, SimulationSettings

Files = Annotated[list[str], typer.Argument(help="Result files or patterns.", show_default=False)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
SampleStep = Annotated[
    float | None,
    typer.Option(
        "--sample-step",
        "--step",
        help="Interval between samples in s, for files without times; --step for short.",
    ),
]
SampleStepAlone = Annotated[
    float | None,
    typer.Option("--sample-step", help="Interval between samples in s, for files without times."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]
IntervalFile = Annotated[
    Path | None, typer.Option("--intervals", help="Prediction intervals made by dfsm calibrate.")
]
ParameterFile = Annotated[
    Path | None, typer.Option("--parameters", help="CSV: a column of runs, one per parameter.")
]


def parametrized(runs: list[Trajectory], table: Path | None) -> list[Trajectory]:
    """Runs with the parameters of a table, if there is one."""
    from dfsm.data.parameters import read_parameters, with_parameters

    return runs if table is None else with_parameters(runs, read_parameters(table))


Method = Annotated[str, typer.Option(help="rk4, tsit5 or kvaerno5 (stiff).")]
Step = Annotated[
    float | None, typer.Option(help="Largest RK4 step in s; default the run's samples.")
]
Interpolation = Annotated[
    str | None,
    typer.Option(
        help="Inputs between samples: hold, linear or cubic, or by name, u=hold,w=cubic; default "
        "as in the model."
    ),
]


def marching(method: str, step: float | None, interpolation: str | None) -> SimulationSettings:
    """How to simulate, as the command line says.

    Raises
    ------
    DfsmError
        There is no such method or way to interpolate.
    """
    from dfsm.data.between import parse_chosen
    from dfsm.simulation.simulate import METHODS, SimulationSettings

    if method not in METHODS:
        raise DfsmError(f"--method is '{method}', expected one of {', '.join(METHODS)}")
    between = parse_chosen(interpolation)
    return SimulationSettings(method=method, step=step, interpolation=between)  # pyright: ignore[reportArgumentType]


@contextmanager
def working(quiet: bool) -> Iterator[None]:
    """Long work: bars on a terminal; with --quiet neither these nor warnings."""
    with show_progress(not quiet), hushed() if quiet else nullcontext():
        yield


def fit_start(model: DFSM) -> float | None:
    """Start of the fit's time window in s: where a simulation starts unless told otherwise."""
    return model.provenance.record.get("settings", {}).get("start")


def as_in_fit(model: DFSM, runs: Iterable[Trajectory]) -> list[Trajectory]:
    """Runs whose slower channels are filled as they were in the fit."""
    from dfsm.data.slower import fill_slower

    between = model.provenance.record.get("settings", {}).get("slower")
    return [fill_slower(run, between) for run in runs]


def tell_notes(runs: Iterable[Trajectory], quiet: bool) -> None:
    """Print what readers left out or changed, each sentence once, on standard error."""
    from dfsm.data.info import counted

    for text in () if quiet else counted([(run.where, run.notes) for run in runs]):
        print(printable(f"note: {text}"), file=sys.stderr)


def tell_timings(steps: Mapping[str, float], total: float, compiled: tuple[float, int]) -> None:
    """Print where the time went, on standard error.

    Parameters
    ----------
    steps
        Seconds of each step of a fit.
    total
        Seconds from the command's start, imports not counted.
    compiled
        Seconds that went into compiling during all of it, and the number of programs.
    """
    parts = {**steps, "reading and saving": total - sum(steps.values())}
    width = max(map(len, parts))
    for name, seconds in parts.items():
        print(f"{name:{width}} {seconds:8.2f} s", file=sys.stderr)
    print(
        f"{'in all':{width}} {total:8.2f} s, of which compiling {compiled[0]:.2f} s "
        f"({compiled[1]} programs)",
        file=sys.stderr,
    )


def lines(text: str) -> str:
    """Text that may hold names, safe to print."""
    return "\n".join(printable(line) for line in text.split("\n"))


def say(message: str, quiet: bool) -> None:
    """Print one line, unless --quiet says not to."""
    if not quiet:
        typer.echo(message)


def print_json(value: Any) -> None:
    """Print a value that strict JSON can hold."""
    # ASCII, so that it is JSON in every terminal's encoding.
    typer.echo(json.dumps(value, indent=2, allow_nan=False))


def exit_if_ended(simulations: list[Simulation], quiet: bool) -> None:
    """Leave with exit code 1 where a simulation ended early, and say how many did."""
    from dfsm.simulation.simulate import Status

    ended = [s for s in simulations if s.status is not Status.COMPLETED]
    if ended:
        if not quiet:
            print(f"{len(ended)} of {len(simulations)} simulations ended early", file=sys.stderr)
        raise typer.Exit(1)
