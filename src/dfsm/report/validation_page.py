"""Write the report: one HTML file that needs no network, for the browser and for print."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from dfsm.errors import DfsmError
from dfsm.report import first_screen, sections
from dfsm.report import runs as by_run
from dfsm.report.document import document, write_document
from dfsm.report.elements import Markup, element, join, plural
from dfsm.report.figures import page_data
from dfsm.validation.results import RunComparison, Validation

_PSD_NOTE = "Welch's estimate, Hann windows of 200 s, unfiltered signals. "
_ERRORS_NOTE = (
    "Simulated minus recorded, all samples of the test runs that every variant completed "
    "(one that completed none is left out); the "
    "outermost bins hold what lies beyond."
)


def write_report(
    validations: Mapping[str, Validation],
    path: str | Path,
    *,
    title: str = "Derivative function surrogate models: validation",
) -> None:
    """Write one self-contained HTML page about one or several validated models.

    Parameters
    ----------
    validations
        By the name under which the fitted model is shown, e.g. ``{"6 m/s": …, "12 m/s": …}``.
    path
        File to write; an existing one is replaced when the new one is complete.
    title
        Heading of the page.

    Raises
    ------
    DfsmError
        No validations, or the file cannot be written.
    """
    if not validations:
        raise DfsmError("no validations were given, a report needs at least one")
    write_document(_page(validations, title), path)


def _page(validations: Mapping[str, Validation], title: str) -> str:
    body = join(_header(validations, title), _main(validations))
    return document(title, body, page_data(validations), scripts=("panels.js", "page.js"))


# -- layout -------------------------------------------------------------------------------------


def _header(validations: Mapping[str, Validation], title: str) -> Markup:
    """Verdict and figure before anything else: a reader may stop there."""
    return element(
        "header",
        element("h1", title),
        first_screen.verdict(validations),
        _figure("verdict-plot", "Error of every signal"),
        element("p", id="verdict-key", cls="note"),
        first_screen.cautions(validations),
    )


def _how(validations: Mapping[str, Validation]) -> Markup:
    names = {r.recorded.name for v in validations.values() for r in v.runs}
    models = plural(len(validations), "fitted model")
    text = (
        f"{models}, {plural(len(names), 'test run')}. Every model variant is simulated from the "
        "recorded initial state with the recorded inputs of each test run, and its states and "
        "outputs are compared with the recorded ones along its own rollout. Figures "
        "in the tables come from all samples; the curves are thinned to about 5 Hz for display, "
        "and further where that cannot be seen."
    )
    return element("p", text, cls="note")


def _main(validations: Mapping[str, Validation]) -> Markup:
    parts = [
        _section(
            "summary",
            "Summary",
            *[sections.completions(name, v) for name, v in validations.items()],
            sections.glance(validations),
            _per_model(validations, sections.verdicts),
            _how(validations),
        ),
        _controls(),
        _section("accuracy", "Accuracy", _per_model(validations, sections.accuracy)),
        _section(
            "series",
            "Time series",
            _per_model(validations, sections.shading) if _shaded(validations) else "",
            _figure("series-plot", "Time series", endings=True),
        ),
        _section(
            "spectra",
            "Power spectral densities",
            element("p", _PSD_NOTE, element("span", id="bands"), cls="note"),
            _figure("spectra-plot", "Power spectral densities"),
            _per_run(validations, by_run.peaks),
        ),
        _section(
            "errors",
            "Error distribution",
            element("p", _ERRORS_NOTE, cls="note"),
            _figure("errors-plot", "Error histograms"),
        ),
        _section(
            "loads",
            "Ranges and loads",
            _per_run(validations, by_run.ranges),
            _per_run(validations, by_run.damage),
        ),
        _section(
            "model",
            "Inside the model",
            _per_model(validations, sections.derivatives),
            _per_model(validations, sections.decisions),
            _figure("eigenvalues-plot", "Eigenvalues in the complex plane"),
            _per_model(validations, sections.eigenvalues),
            _per_model(validations, sections.times),
        ),
        _section("record", "Settings and data", _per_model(validations, sections.provenance)),
    ]
    return element("main", *parts)


def _shaded(validations: Mapping[str, Validation]) -> bool:
    return any(v.intervals is not None for v in validations.values())


def _section(key: str, heading: str, *children: object) -> Markup:
    return element("section", element("h2", heading), *children, id=key)


def _controls() -> Markup:
    """Choose what the figures and tables below show; page.js fills and shows it."""
    return element(
        "form",
        element("label", "Fitted model ", element("select", id="pick-model")),
        element("label", "Test run ", element("select", id="pick-run")),
        element("fieldset", element("legend", "Curves"), id="pick-variants"),
        element(
            "fieldset",
            element("legend", "Time (s)"),
            element("input", id="from", type="number", step="any", aria_label="from, s"),
            element("span", "to"),
            element("input", id="to", type="number", step="any", aria_label="to, s"),
            element("button", "All", id="whole", type="button"),
        ),
        id="controls",
        hidden=True,
        autocomplete="off",
    )


def _figure(key: str, label: str, endings: bool = False) -> Markup:
    return element(
        "figure",
        element("figcaption", f"{label}: ", element("span", cls="context")),
        element("div", id=key, cls="plot", role="img", aria_label=label),
        element("ul", id="endings", cls="note") if endings else "",
        element("noscript", "The figures need JavaScript; every figure in a table does not."),
    )


def _per_model(
    validations: Mapping[str, Validation], part: Callable[[str, Validation], Markup]
) -> Markup:
    return join(
        *[
            element("div", part(name, v), data_model=i)
            for i, (name, v) in enumerate(validations.items())
        ]
    )


def _per_run(
    validations: Mapping[str, Validation],
    part: Callable[[str, Validation, RunComparison], Markup],
) -> Markup:
    return join(
        *[
            element("div", part(name, v, run), data_model=i, data_run=j)
            for i, (name, v) in enumerate(validations.items())
            for j, run in enumerate(v.runs)
        ]
    )
