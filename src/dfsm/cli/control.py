"""Commands for solutions of optimal control problems; `cli` puts them beside the others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.terminal import AsJson, Quiet, lines, print_json, say

Result = Annotated[Path, typer.Argument(help="Solution folder made by save_solution.")]
Scenario = Annotated[int, typer.Option(help="Which scenario, from 1.")]


def export_rosco(
    result: Result,
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.")],
    pitch: Annotated[str | None, typer.Option(help="Control that is the blade pitch.")] = None,
    torque: Annotated[str | None, typer.Option(help="Control that is the torque.")] = None,
    scenario: Scenario = 1,
    step: Annotated[
        float | None, typer.Option(help="Time between rows in s; default the solution's nodes.")
    ] = None,
    discon: Annotated[
        Path | None,
        typer.Option(help="DISCON.IN to fly it with: limits that it breaks are named."),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Write optimal torque and pitch as an open-loop input file of ROSCO."""
    from dfsm.control import load_solution
    from dfsm.core.files import check_file
    from dfsm.exports.rosco import write_rosco

    check_file(output)
    written = write_rosco(
        load_solution(result),
        output,
        pitch=pitch,
        torque=torque,
        scenario=scenario,
        step=step,
        discon=discon,
    )
    if as_json:
        settings = {
            "pitch": written.pitch,
            "torque": written.torque,
            "discon": dict(written.discon),
            "notes": list(written.notes),
        }
        print_json({"output": str(output), "rows": written.rows, **settings, "Ptch_Cntrl": 1})
        return
    say(lines(f"wrote {output} ({written.rows} rows); to use it, set"), quiet)
    for line in written.lines():
        say(lines(line), quiet)


def check_run(
    result: Result,
    run: Annotated[str, typer.Argument(help="High-fidelity run under the optimal controls.")],
    scenario: Scenario = 1,
    ratio: Annotated[
        float | None,
        typer.Option(help="Speed of the torque's shaft over that of the speed, for the power."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare a high-fidelity run under optimal controls with what was predicted."""
    from dfsm.cli.tables import print_check
    from dfsm.control import check_run as compare
    from dfsm.control import load_solution
    from dfsm.data.readers import read

    comparison = compare(load_solution(result), read(run), scenario, ratio)
    if as_json:
        print_json(comparison.to_dict())
    else:
        print_check(comparison)
