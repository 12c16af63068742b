"""The command that turns wind fields into disturbances; `cli` puts it beside the others."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dfsm.cli.terminal import Files, Quiet, SampleStep, say, tell_notes, working
from dfsm.errors import DfsmError

if TYPE_CHECKING:
    from dfsm.data.readers.uniform import UniformWind
    from dfsm.data.trajectory import Trajectory
    from dfsm.data.wind_field import WindField

Box = tuple[int, int, int, float, float, float]


def wind(
    field: Annotated[
        Path,
        typer.Argument(
            help="Wind that drove the runs: TurbSim (.bts), u of a Mann box, or a uniform wind."
        ),
    ],
    files: Files,
    radius: Annotated[float, typer.Option(help="Rotor radius in m.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the new files.")],
    harmonics: Annotated[
        int, typer.Option(help="Highest azimuthal harmonic over rings; 0 for none.")
    ] = 4,
    rings: Annotated[
        str | None,
        typer.Option(help="Radii of the rings in m, as 36,78,116; default six over the rotor."),
    ] = None,
    box: Annotated[
        Box | None,
        typer.Option(
            metavar="NX NY NZ DX DY DZ",
            help="The field is a Mann box: numbers of points and spacings in m along x, y, z.",
        ),
    ] = None,
    mean_wind: Annotated[
        float | None, typer.Option(help="Mann box: mean wind in m/s at hub height.")
    ] = None,
    hub_height: Annotated[
        float | None,
        typer.Option(
            help="Height of the turbine's hub in m; default the field's. Mann box: also of its "
            "middle."
        ),
    ] = None,
    reference_height: Annotated[
        float | None,
        typer.Option(help="Uniform wind: height of its speed in m (RefHt_Uni); default the hub's."),
    ] = None,
    reference_length: Annotated[
        float | None,
        typer.Option(
            help="Uniform wind: length of its linear shears in m (RefLength); default the rotor's "
            "diameter."
        ),
    ] = None,
    shear: Annotated[
        float | None, typer.Option(help="Mann box: exponent of the mean wind's power law.")
    ] = None,
    scale: Annotated[float | None, typer.Option(help="Mann box: factor of its turbulence.")] = None,
    last_first: Annotated[
        bool, typer.Option("--last-first", help="Mann box: its last plane meets the rotor first.")
    ] = False,
    step: SampleStep = None,
    quiet: Quiet = False,
) -> None:
    """Add the wind over the rotor, its slopes and harmonics to runs: disturbances to fit with."""
    from dfsm.core.bundle import check_no_bundle
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import check_file
    from dfsm.data.apart import require_apart
    from dfsm.data.readers import read_all
    from dfsm.data.readers.tables import write_table

    told = {"mean-wind": mean_wind, "hub-height": hub_height, "shear": shear, "scale": scale}
    told |= {"reference-height": reference_height, "reference-length": reference_length}
    radii = None if rings is None else _radii(rings)
    source = _open(field, box, told, last_first)
    check_no_bundle(output)
    with working(quiet):
        runs = read_all(files, step=step)
        tell_notes(runs, quiet)
        targets = [output / f"{Path(run.where).stem}.parquet" for run in runs]
        require_apart(runs, targets)
        output.mkdir(parents=True, exist_ok=True)
        for target in targets:
            check_file(target, [run.source for run in runs])
        added = _with_wind(runs, source, radius, harmonics, radii)
    more = "RotWind, RotShearV and RotShearH"
    more += f", and harmonics 1 to {harmonics} over rings" if harmonics else ""
    whose = "as told" if hub_height is not None else "as the field states"
    say(f"hub at {source.hub_height:g} m, {whose}", quiet)
    for run, target in zip(added, targets, strict=True):
        write_or_keep(partial(write_table, run), target)
        say(f"wrote {target} with {more}", quiet)


def _radii(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise DfsmError(f"--rings is '{text}', expected radii in m as in 36,78,116") from None


def _with_wind(
    runs: Sequence[Trajectory],
    source: WindField | UniformWind,
    radius: float,
    harmonics: int,
    radii: Sequence[float] | None,
) -> list[Trajectory]:
    """Runs with the signals of the wind that drove them."""
    from dfsm.data.readers.uniform import UniformWind
    from dfsm.data.wind_field import field_signals, with_field_wind, with_signals

    if isinstance(source, UniformWind):
        # It has no time steps of its own.
        return [
            with_field_wind(run, source.over(run.time, radius), radius, harmonics, radii)
            for run in runs
        ]
    signals = field_signals(source, radius, harmonics, radii)
    return [with_signals(run, source, signals) for run in runs]


def _open(
    path: Path, box: Box | None, told: dict[str, float | None], last_first: bool
) -> WindField | UniformWind:
    """Open a field of the format that the options and the file tell."""
    from dfsm.core.files import existing_file
    from dfsm.data.readers.turbsim import read_turbsim
    from dfsm.data.readers.uniform import UniformSettings, is_uniform, read_uniform

    names = [n for n, value in told.items() if value is not None and n != "hub-height"]
    names += ["last-first"] if last_first else []
    of_uniform = [n for n in names if n.startswith("reference-")]
    if box is not None:
        if of_uniform:
            raise DfsmError(f"--{of_uniform[0]} is for a uniform wind, --box for another: give one")
        return _open_box(path, box, told, last_first)
    of_box = [n for n in names if n not in of_uniform]
    if of_box:
        raise DfsmError(f"--{of_box[0]} is for a Mann box: give its sizes with --box, or leave it")
    hub = told["hub-height"]
    if not is_uniform(existing_file(path)):
        if of_uniform:
            raise DfsmError(f"--{of_uniform[0]} is for a uniform wind, {path} is none: leave it")
        field = read_turbsim(path)
        return field if hub is None else field.at_hub(hub)
    if hub is None:
        raise DfsmError(f"{path}: a uniform wind has no hub: give its height with --hub-height")
    settings = UniformSettings(
        hub_height=hub,
        reference_height=told["reference-height"],
        reference_length=told["reference-length"],
    )
    return read_uniform(path, settings)


def _open_box(path: Path, box: Box, told: dict[str, float | None], last_first: bool) -> WindField:
    """Open a Mann box of the sizes told."""
    from dfsm.data.readers.mann import BoxSettings, read_mann

    mean_wind, hub_height = told["mean-wind"], told["hub-height"]
    if mean_wind is None or hub_height is None:
        lost = "--mean-wind" if mean_wind is None else "--hub-height"
        raise DfsmError(f"{path}: a Mann box does not tell its {lost[2:]}: give it with {lost}")
    settings = BoxSettings(
        points=box[:3],
        spacing=box[3:],
        mean_wind=mean_wind,
        hub_height=hub_height,
        shear=told["shear"] or 0.0,
        scale=told["scale"],
        last_first=last_first,
    )
    return read_mann(path, settings)
