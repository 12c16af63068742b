"""The command line: one verb per thing a user wants; every mistake is one sentence.

Exit codes: 0 done · 1 done, but a simulation ended early or a problem was not solved · 2 bad
input · 3 a bug in dfsm · 130 interrupted.
"""

from __future__ import annotations

import gc
import io
import os
import signal
import sys
import time
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.closed_loop import closed_loop
from dfsm.cli.control import check_run, export_rosco
from dfsm.cli.export import exports
from dfsm.cli.intervals import calibrate
from dfsm.cli.optimize import optimize
from dfsm.cli.report import report
from dfsm.cli.simulate import simulate
from dfsm.cli.sweep import sweep
from dfsm.cli.targets import check_json, check_page, check_spared
from dfsm.cli.terminal import (
    AsJson,
    Files,
    Interpolation,
    IntervalFile,
    Method,
    ParameterFile,
    Quiet,
    SampleStep,
    SampleStepAlone,
    Step,
    as_in_fit,
    exit_if_ended,
    fit_start,
    lines,
    marching,
    parametrized,
    print_json,
    say,
    tell_notes,
    tell_timings,
    working,
)
from dfsm.cli.tune import tune
from dfsm.cli.wind import wind
from dfsm.core.progress import show_progress
from dfsm.errors import DfsmError, DfsmWarning, printable

# Objects that may be made before the interpreter looks for cycles among them.
_SELDOM = 50_000

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Derivative function surrogate models from time-domain simulations.",
)
demos = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Studies that bring their own simulations."
)
app.add_typer(demos, name="demo")
app.add_typer(exports, name="export")
app.command()(simulate)
app.command()(optimize)
app.command("export-rosco")(export_rosco)
app.command("check-run")(check_run)
app.command()(calibrate)
app.command()(report)
app.command()(wind)
app.command("closed-loop")(closed_loop)
app.command()(sweep)
app.command()(tune)


@app.command()
def info(
    files: Files,
    each: Annotated[bool, typer.Option("--each", help="A table for every run.")] = False,
    step: SampleStep = None,
    as_json: AsJson = False,
) -> None:
    """List channels, units, ranges, sampling and quantisation, and what looks wrong."""
    from dfsm.cli.tables import print_info, print_merged
    from dfsm.data.readers import describe_all

    with show_progress():
        infos = describe_all(files, step=step)
    if as_json:
        print_json([i.to_dict() for i in infos])
    elif each or len(infos) == 1:
        print_info(infos)
    else:
        print_merged(infos)


@app.command()
def init(
    files: Files,
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.")] = Path(
        "config.yaml"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    step: SampleStep = None,
    quiet: Quiet = False,
) -> None:
    """Write a commented configuration with the channels of the files."""
    from dfsm.config.template import write_config
    from dfsm.core.files import check_file

    check_file(output)
    if output.exists() and not force:
        raise DfsmError(f"{output} exists: choose another name with -o, or replace it with --force")
    with working(quiet):
        told = write_config(files, output, step)
    if told:
        say(told, quiet)
    say(f"wrote {output}: check the signals, then run: dfsm fit {output} -o model/", quiet)


@app.command()
def fit(
    config: Annotated[Path, typer.Argument(help="Configuration made by dfsm init.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Model folder to write.")],
    interpolation: Annotated[
        str | None,
        typer.Option(
            help="Inputs between samples, before those of the configuration: hold, linear or "
            "cubic, or by name, u=hold,w=cubic."
        ),
    ] = None,
    timings: Annotated[
        bool, typer.Option("--timings", help="Print where the time went, on standard error.")
    ] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Fit a multi-fidelity model and save it as a folder."""
    from dfsm.config.fit import load_config
    from dfsm.core.compile_clock import compile_clock
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import visible
    from dfsm.core.lock import locked
    from dfsm.data.between import combined, parse_chosen
    from dfsm.fitting.fit import fit as run_fit
    from dfsm.models.model_folder import check_target, save
    from dfsm.models.summary import lines_of

    check_target(output)
    chosen = parse_chosen(interpolation)
    begin, compiling = time.perf_counter(), compile_clock()
    with locked(output):
        with working(quiet):
            config_settings, runs = load_config(config, whole=False)
            tell_notes(runs, quiet)
            settings = config_settings.fit_settings()
            if chosen is not None:
                names = (*settings.controls, *settings.driving)
                settings = replace(settings, inputs=combined(chosen, settings.inputs, names))
            count = len(runs)
            # Handed over one by one: where channels are computed, the fit has runs of its own.
            given = (runs.pop(0) for _ in range(count))
            result = run_fit(given, settings, config_settings.refine)
            model = result.model
        replaced = output.exists() and bool(visible(output))
        write_or_keep(lambda path: save(model, path, result.nonlinear), output)
    if timings:
        tell_timings(result.seconds, time.perf_counter() - begin, compiling())
    if replaced and not quiet:
        print(printable(f"note: replaced the model that was in {output}"), file=sys.stderr)
    if as_json:
        from dfsm.core.files import json_value

        print_json(json_value(dict(model.provenance.record)))
        return
    # Its warnings have been shown.
    say(lines("\n".join(lines_of(model, warnings=False))), quiet)
    seconds = sum(result.seconds.values())
    say(
        f"fitted {count} run{'s' * (count > 1)} in {seconds:.1f} s, saved in {output}",
        quiet,
    )


@app.command()
def compare(
    config: Annotated[Path, typer.Argument(help="Configuration with a key 'compare'.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for models and results.")],
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Fits at a time; default half the processors.")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Fit several structures and rank them on runs held out; goes on where it was ended."""
    from dfsm.cli.tables import print_ranking
    from dfsm.config.fit import parse_candidates
    from dfsm.data.readers import read_all
    from dfsm.selection.compare import check_output
    from dfsm.selection.compare import compare as run_compare

    settings, candidates = parse_candidates(config)
    check_output(output, candidates)
    files, hold_out = settings.compare.validation, settings.compare.hold_out
    with working(quiet):
        step = settings.data.step
        runs = settings.with_parameters(read_all(settings.data.train, config.parent, step))
        validation = None
        if files is not None:
            validation = settings.with_parameters(read_all(files, config.parent, step))
        tell_notes([*runs, *(validation or [])], quiet)
        ranking = run_compare(
            candidates, runs, output, validation=validation, hold_out=hold_out, jobs=jobs
        )
    if ranking.best is None:
        raise DfsmError("; ".join(ranking.failures()))
    if as_json:
        print_json(ranking.to_dict())
    elif not quiet:
        print_ranking(ranking)
    if ranking.best.score is None:
        raise typer.Exit(1)


@app.command()
def summary(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
) -> None:
    """Describe a saved model: signals, decisions, eigenvalues, warnings."""
    from dfsm.models.model_folder import load

    loaded = load(model)
    # A file or another program is given whole lines.
    typer.echo(lines(str(loaded) if sys.stdout.isatty() else loaded.summary()))


@app.command()
def validate(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    files: Files,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="HTML report to write.")
    ] = None,
    metrics: Annotated[
        Path | None, typer.Option("--json", help="JSON file with all figures to write.")
    ] = None,
    wall_times: Annotated[
        Path | None,
        typer.Option(help="JSON file: run name to seconds the simulator took, for speed-ups."),
    ] = None,
    start: Annotated[
        float | None, typer.Option(help="Start of the test window in s; default as in the fit.")
    ] = None,
    stop: Annotated[float | None, typer.Option(help="End of the test window in s.")] = None,
    method: Method = "rk4",
    step: Step = None,
    sample_step: SampleStepAlone = None,
    interpolation: Interpolation = None,
    intervals: IntervalFile = None,
    parameters: ParameterFile = None,
    quiet: Quiet = False,
) -> None:
    """Simulate test runs, compare with what was recorded, write a report."""
    from dfsm.cli.tables import print_validation
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import write_json
    from dfsm.data.readers import read_all, with_wall_times
    from dfsm.models.model_folder import NONLINEAR, load_all
    from dfsm.report import write_report
    from dfsm.validation.intervals import load_intervals
    from dfsm.validation.validate import compared
    from dfsm.validation.validate import validate as run_validate

    settings = marching(method, step, interpolation)
    targets = [path for path in (output, metrics) if path is not None]
    if output is not None:
        check_page(output)
    if metrics is not None:
        check_json(metrics, "a file of figures")
    models = load_all(model)
    main = next(iter(models.values()))
    start = fit_start(main) if start is None else start
    calibrated = None if intervals is None else load_intervals(intervals)
    with working(quiet):
        runs = as_in_fit(main, parametrized(read_all(files, step=sample_step), parameters))
        tell_notes(runs, quiet)
        sources = [wall_times, intervals, parameters, *(r.source for r in runs)]
        check_spared(targets, model, main, sources, sample_step)
        if wall_times is not None:
            runs = with_wall_times(runs, wall_times)
        candidates = compared(main, models.get(NONLINEAR))
        validation = run_validate(
            candidates, runs, start=start, stop=stop, settings=settings, intervals=calibrated
        )
        if output is not None:
            label = model.name or str(model)
            write_or_keep(lambda path: write_report({label: validation}, path), output)
    if metrics is not None:
        write_or_keep(lambda path: write_json(path, validation.to_dict()), metrics)
    if not quiet:
        print_validation(validation)
    for path in targets:
        say(f"wrote {path}", quiet)
    exit_if_ended(
        [r.models[m].simulation for r in validation.runs for m in ("multi-fidelity",)], quiet
    )


@demos.command("two-link-robot")
def two_link_robot(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the page, its tables and figures.")
    ] = Path("out"),
    quick: Annotated[bool, typer.Option("--quick", help="Less of everything: a minute.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the simulations and fits.")] = 0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Repeat the paper's study of two robot arms, and go beyond it: about four minutes."""
    from dfsm.cli.tables import print_article
    from dfsm.core.files import json_value
    from dfsm.demos.two_link_robot.article import KEY, robot_article
    from dfsm.demos.two_link_robot.study import QUICK, study
    from dfsm.report.publish import page_of, publish

    page_of(output, KEY)
    with working(quiet):
        article = robot_article(study(QUICK if quick else None, seed))
    written = publish(article, output)
    if as_json:
        print_json(json_value(article.to_dict()))
        return
    if not quiet:
        print_article(article)
    figures = (
        f", {len(written) - 2} files in {output / 'figures'}"
        if len(written) > 2
        else ("; figures for print need matplotlib: pip install 'dfsm[figures]'")
    )
    say(f"wrote {written[0]}, {written[1]}{figures}", quiet)


def main() -> None:
    """Run the command line; the only place that turns errors into exit codes."""
    # What imports and traces leave is kept to the end; looking through it for cycles finds none.
    gc.set_threshold(_SELDOM)
    # Ended by a queue or a service manager, a command cleans up as after Ctrl-C.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        _main()
    finally:
        signal.signal(signal.SIGTERM, before)


def _main() -> None:
    warnings.showwarning = partial(_show_warning, set[str]())
    warnings.simplefilter("always", DfsmWarning)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A terminal that lacks a letter shows an escape instead of failing.
        sys.stdout.reconfigure(errors="backslashreplace")
    code = _run()
    try:
        sys.stdout.flush()
    except OSError as error:
        # The reader of our output has gone (… | head), or the disk it goes to is full. Without
        # this, the interpreter would try again on its way out and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            code = _fail(f"error: standard output could not be written ({error.strerror})", 2)
    sys.exit(code)


def _run() -> int:
    try:
        code = app(prog_name="dfsm", standalone_mode=False)
        if code == 130:  # the command-line library has caught Ctrl-C already
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except DfsmError as error:
        return _fail(f"error: {error}", 2)
    except KeyboardInterrupt:
        return _fail("interrupted: nothing was left half-written", 130)
    except BrokenPipeError:
        return 0
    except SystemExit as stop:
        # Libraries turn a pipe that nobody reads any more into exit code 1; nothing went wrong.
        return 0 if isinstance(stop.__context__, BrokenPipeError) else 3
    except OSError as error:
        where = error.filename or "standard output"
        return _fail(f"error: {where} cannot be used ({error.strerror or error})", 2)
    except Exception as error:
        return _unexpected(error)


def _unexpected(error: Exception) -> int:
    """Usage errors of the command-line library, and bugs."""
    kind = type(error).__name__
    if kind == "NoArgsIsHelpError":
        print(str(error), file=sys.stderr)
        return 2
    if hasattr(error, "format_message"):
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "dfsm"
        text = str(error.format_message()).rstrip(".")  # pyright: ignore[reportAttributeAccessIssue]
        return _fail(f"error: {text[:1].lower()}{text[1:]}; see {command} --help", 2)
    if kind == "Abort":
        return _fail("interrupted: nothing was left half-written", 130)
    if os.environ.get("DFSM_DEBUG"):
        raise error
    print(f"bug in dfsm: {kind}: {error}", file=sys.stderr)
    return _fail("please report it with the traceback that DFSM_DEBUG=1 shows", 3)


def _fail(message: str, code: int) -> int:
    print(printable(message), file=sys.stderr)
    return code


def _show_warning(
    shown: set[str], message: Warning | str, category: type[Warning], *_: object
) -> None:
    """Print what was not printed before: a command may look at the same file several times."""
    text = str(message)
    if issubclass(category, DfsmWarning) and text not in shown:
        shown.add(text)
        print(printable(f"warning: {text}"), file=sys.stderr)


if __name__ == "__main__":
    main()
