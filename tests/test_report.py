"""The HTML report: self-contained, true to the figures, and deaf to markup in names."""

from __future__ import annotations

import base64
import json
import re
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from dfsm.cli.tables import print_validations
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LTI
from dfsm.fitting.settings import FitSettings
from dfsm.report import write_report
from dfsm.report.document import embed
from dfsm.report.elements import element, number
from dfsm.report.figures import thin
from dfsm.simulation.simulate import Status
from dfsm.validation.intervals import Intervals
from dfsm.validation.validate import compared, validate

STATE = "</script><img src=x onerror=alert(1)>"
OUTPUT = "<b>x</b>"
UNIT = "<i>kN</i>&\u2028"
RUN = "<svg onload=\"document.title='owned'\"> {}"
VARIANTS = ["linear-fit", "multi-fidelity", "nonlinear-only"]


class Page(HTMLParser):
    """Tags, attributes, tables (rows of cell texts) and scripts of a page."""

    def __init__(self, path):
        super().__init__()
        self.tags, self.attributes, self.tables, self.scripts, self.words = [], [], [], [], []
        self._script = None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *a) for a in attrs]
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        self._script = dict(attrs) if tag == "script" else None

    def handle_endtag(self, tag):
        if tag == "table":
            self.tables.append([[""]])

    def handle_data(self, data):
        if self._script is not None:
            self.scripts.append((self._script, data))
        elif self.tables and self.tables[-1] and self.tables[-1][-1]:
            self.tables[-1][-1][-1] += data
        self.words.append(data if self._script is None else "")

    @property
    def text(self):
        return " ".join("".join(self.words).split())

    @property
    def data(self):
        return json.loads(next(d for s, d in self.scripts if s.get("type") == "application/json"))

    def rows(self, *heads):
        """Body rows of the tables whose last header row starts with the given heads."""
        return [t[2:] for t in self.tables if len(t) > 2 and tuple(t[1][: len(heads)]) == heads]


def oscillator(seed, name):
    """Simulate x'' = u - 2 x - 0.4 x' - 0.2 x³, with semi-implicit Euler steps."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 60, 0.05)
    tones = rng.uniform(0.1, 2.0, 5)
    u = np.sum([np.sin(w * time + p) for w, p in zip(tones, rng.uniform(0, 6, 5), strict=True)], 0)
    x = np.zeros((len(time), 2))
    for i in range(len(time) - 1):
        rate = x[i, 1] + 0.05 * (u[i] - 2 * x[i, 0] - 0.4 * x[i, 1] - 0.2 * x[i, 0] ** 3)
        x[i + 1] = x[i, 0] + 0.05 * rate, rate
    channels = (Channel(STATE, "rpm"), Channel("u", "N"), Channel(OUTPUT, UNIT))
    values = np.stack([x[:, 0], u, 5 + 3 * x[:, 0] + u], axis=1)
    return Trajectory(time, values, channels, name=RUN.format(name), wall_time=30.0)


@pytest.fixture(scope="module")
def validation():
    choices = FitSettings(
        states=(StateSpec(name=STATE, order=2),),
        controls=("u",),
        outputs=(OUTPUT,),
        linear=LTI(),
        corrective=RBF(samples=40),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = fit([oscillator(i, f"train {i}") for i in range(2)], choices)
        tests = [oscillator(i, f"test {i}") for i in (7, 8)]
        return validate(compared(result.model, result.nonlinear), tests, start=5.0)


@pytest.fixture(scope="module")
def broken(validation):
    """Pretend that the multi-fidelity rollout of the second run ran away."""
    run = validation.runs[1]
    model = run.models["multi-fidelity"]
    part = model.simulation.trajectory.window(5.0, 20.0)
    grown = part.values * np.linspace(1, 1e6, len(part))[:, None]
    ended = replace(
        model,
        simulation=replace(
            model.simulation,
            trajectory=replace(part, values=grown),
            status=Status.LEFT_REGION,
            ended=20.0,
            reason="x_dot reached 99.5 m/s at 20.05 s (training range -1 to 1)",
        ),
        errors={},
        statistics={},
    )
    changed = replace(run, models={**run.models, "multi-fidelity": ended})
    return replace(validation, runs=(validation.runs[0], changed))


@pytest.fixture(scope="module")
def page(validation, broken, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report({"all <em>winds</em>": validation, "broken": broken}, path, title="A & <b>B</b>")
    return Page(path)


def unpacked(blob):
    """An array as the page's script reads it."""
    kind, offset, step, text = blob
    data = base64.b64decode(text)
    if kind == "f4":
        return offset + np.frombuffer(data, "<f4").astype(float)
    steps = np.frombuffer(data, "<u2").astype(float)
    exact = offset + step * np.where(steps == 65535, np.nan, steps)
    return 10**exact if kind == "log" else exact


def value(text):
    return float(text.replace("\N{NARROW NO-BREAK SPACE}", "").replace("\N{MINUS SIGN}", "-"))


def close(text, expected):
    return value(text) == pytest.approx(expected, rel=6e-3)


def test_accuracy_is_what_the_validation_says(page, validation):
    found = validation.to_dict()
    rows = page.rows("Channel", "Unit", "Role")[0]
    assert [r[0] for r in rows] == [c["name"] for c in found["channels"]]
    for row in rows:
        for i, model in enumerate(VARIANTS):
            errors = [r["models"][model]["errors"][row[0]] for r in found["runs"]]
            nrmse, rmse, most = row[3 + 3 * i : 6 + 3 * i]
            assert close(nrmse, found["models"][model]["mean_nrmse"][row[0]])
            assert close(rmse, np.mean([e["rmse"] for e in errors]))
            assert close(most, max(e["maximum"] for e in errors))


def test_summary_is_what_the_validation_says(page, validation):
    found = validation.to_dict()["models"]
    for row, model in zip(page.rows("Fitted model", "Variant")[0], VARIANTS, strict=False):
        assert row[:3] == ["all <em>winds</em>", model, "2 of 2"]
        assert close(row[3], found[model]["mean_nrmse"][STATE])
        assert close(row[-2], found[model]["wall_time_s"])
        assert close(row[-1], found[model]["speed_up"])


def test_run_tables_are_what_the_validation_says(page, validation):
    run = validation.to_dict()["runs"][0]
    for row in page.rows("Channel", "Unit", "min")[0]:
        sides = [run["statistics"], run["models"]["multi-fidelity"]["statistics"]]
        for side, cells in zip(sides, (row[2:6], row[6:10]), strict=True):
            for key, cell in zip(("min", "mean", "max", "std"), cells, strict=True):
                assert close(cell, side[row[0]][key])
    loads = page.rows("Output", "Unit", "Wöhler m")[0]
    assert [r[2] for r in loads] == ["3", "4", "5", "10"]
    for row in loads:
        recorded = run["statistics"][OUTPUT]["del_1hz"][row[2]]
        linear = run["models"]["linear-fit"]["statistics"][OUTPUT]["del_1hz"][row[2]]
        assert close(row[3], recorded)
        assert close(row[4], linear)
        assert value(row[5].removesuffix(" %")) == pytest.approx(
            100 * (linear / recorded - 1), abs=0.06
        )
    for row in page.rows("Channel", "Band")[0]:
        ours = run["models"]["linear-fit"]["statistics"][row[0]]
        if ours["peaks_hz"][row[1]] is None:
            assert row[3] == "—"
            continue
        assert value(row[3]) == pytest.approx(ours["peaks_hz"][row[1]], abs=6e-4)
        recorded = run["statistics"][row[0]]["band_power"][row[1]]
        assert not recorded or close(row[4], ours["band_power"][row[1]] / recorded)


def test_derivatives_and_eigenvalues_are_what_the_validation_says(page, validation):
    errors = [r.models["linear-fit"].derivative_errors for r in validation.runs]
    rows = page.rows("Derivative", "mean", "worst run")[0]
    assert close(rows[1][1], np.mean([e[f"{STATE}_dot"] for e in errors]))
    ((_, values),) = validation.eigenvalues
    table = next(t for t in page.tables if t and t[0][:2] == ["At", "Real (1/s)"])
    assert len(table) - 1 == sum(v.imag >= 0 for v in values)
    assert table[1][-1] == "stable"
    assert close(table[1][1], values[0].real)


def test_series_are_those_of_the_validation(page, validation):
    data = page.data
    run = data["models"][0]["runs"][0]
    drawn = unpacked(data["blobs"][run["recorded"]["y"][0]])
    time = run["recorded"]["t0"] + run["recorded"]["dt"] * np.arange(len(drawn))
    recorded = validation.runs[0].recorded
    assert run["recorded"]["dt"] == pytest.approx(0.2)
    expected = np.interp(time, recorded.time, recorded[STATE])
    np.testing.assert_allclose(drawn, expected, atol=0.02 * recorded[STATE].std())
    assert data["models"][0]["variants"] == VARIANTS


def test_thinning_neither_aliases_nor_moves_the_ends():
    time = np.arange(0, 100, 0.05)
    slow, fast = np.cos(0.3 * time) + 0.01 * time, np.sin(2 * np.pi * 4.9 * time)
    run = Trajectory(time, np.stack([slow, fast], axis=1), (Channel("slow"), Channel("fast")))
    start, step, values = thin(run)
    mesh = start + step * np.arange(len(values))
    np.testing.assert_allclose(values[:, 0], np.interp(mesh, time, slow), atol=5e-3)
    # Plain decimation would draw a wave of full height with a period of 10 s.
    assert np.abs(values[20:-20, 1]).max() < 0.02


def test_thinning_takes_irregular_meshes():
    time = np.sort(np.random.default_rng(0).uniform(0, 100, 2000))
    start, step, values = thin(Trajectory(time, np.sin(time)[:, None], (Channel("x"),)))
    mesh = start + step * np.arange(len(values))
    assert abs(values[:, 0] - np.sin(mesh))[10:-10].max() < 0.1


def test_thinning_does_not_stretch_rounded_times():
    # The steps are 0.013 and 0.014 s, the median is neither their mean nor the true step.
    time = np.round(0.0132 * np.arange(20001), 3)
    start, step, values = thin(Trajectory(time, time[:, None], (Channel("x"),)))
    assert start + step * (len(values) - 1) == pytest.approx(time[-1], abs=step)


def test_incomplete_rollouts_are_told_and_not_scored(page):
    rows = page.rows("Channel", "Unit", "Role")[1]
    assert all(cell == "—a" for row in rows for cell in row[6:9])
    assert all(value(row[3]) > 0 for row in rows)
    assert "multi-fidelity 1 of 2" in page.text
    assert "ended at 20 s of 59.95 s: x_dot reached 99.5 m/s at 20.05 s" in page.text
    run = page.data["models"][1]["runs"][1]
    variant = run["variants"]["multi-fidelity"]
    assert variant["ended"] == 20.0
    assert variant["psd"] is None
    # A rollout that ran away does not decide what the panel shows.
    assert max(abs(x) for r in run["ranges"] for x in r) < 100
    # Loads of that run: a dash for it, figures for the others.
    load = page.rows("Output", "Unit", "Wöhler m")[3][0]
    assert (load[6], load[7]) == ("—", "—")
    assert value(load[4]) > 0


def test_prediction_intervals_are_drawn_and_told(validation, broken, page, tmp_path):
    assert "prediction intervals" not in page.text
    assert ("span", "class", "patch interval") not in page.attributes
    plain = [v for r in page.data["models"][0]["runs"] for v in r["variants"].values()]
    assert not [v for v in plain if "band" in v]
    model = validation.models["multi-fidelity"]
    names, half = tuple(c.name for c in validation.channels), np.array([[0.05, 0.1, 0.2]])
    units = tuple(c.unit for c in validation.channels)
    grid = np.asarray(model.region.grid)
    given = Intervals(names, units, None, grid, half, 0.8, ("c1", "c2", "c3"), ("", "", ""))
    tests = [oscillator(i, f"test {i}") for i in (7, 8)]
    found = validate(validation.models, tests, start=5.0, intervals=given)
    ended = replace(broken, intervals=given)
    write_report({"calm": found, "broken": ended, "plain": validation}, tmp_path / "r.html")
    shaded = Page(tmp_path / "r.html")
    assert "a new run is expected 80 % of the time, calibrated on 3 runs" in shaded.text
    run = shaded.data["models"][0]["runs"][0]
    assert [name for name, v in run["variants"].items() if "band" in v] == ["multi-fidelity"]
    drawn = run["variants"]["multi-fidelity"]

    def curve(series, channel):
        # Lines through the samples that are kept are as good as all of them.
        y = unpacked(shaded.data["blobs"][series["y"][channel]])
        kept = series["every"][channel] * np.arange(len(y))
        return np.interp(np.arange(kept[-1] + 1), kept, y)

    for channel, width in enumerate(half[0]):
        beside = curve(drawn["band"], channel)
        low, high = (curve(drawn, channel) + side * beside for side in (-1, 1))
        np.testing.assert_allclose(high - low, 2 * width, atol=1e-5)
        np.testing.assert_allclose((high + low) / 2, curve(drawn, channel), atol=1e-5)
    calm, runaway = shaded.rows("Channel", "Unit", "smallest")
    for row, c in zip(calm, validation.channels, strict=True):
        shares = found.coverage(c.name)
        assert shares
        figures = (np.mean(shares), min(shares), max(shares))
        assert row[4:] == ["80 %", *(f"{100 * share:.1f} %" for share in figures)]
    assert all(row[4:] == ["80 %", "—", "—", "—"] for row in runaway)


def test_nothing_is_fetched(page):
    assert not [a for a in page.attributes if a[1] in ("src", "href", "srcset", "data", "action")]
    assert not {"link", "img", "iframe", "object", "base", "a"} & set(page.tags)
    policy = next(v for t, k, v in page.attributes if t == "meta" and "default-src" in (v or ""))
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    script_rule = policy.split("script-src")[1].split(";")[0]
    assert "unsafe" not in script_rule


def test_names_never_become_markup(page, tmp_path):
    assert not {"img", "svg", "b", "i", "em"} & set(page.tags)
    assert not [a for a in page.attributes if a[1].startswith("on")]
    assert page.tags.count("script") == 4  # Plotly, two of our own, and the data
    for text in (STATE, OUTPUT, "A & <b>B</b>", "all <em>winds</em>", RUN.format("test 7")):
        assert " ".join(text.split()) in page.text
    assert page.data["models"][0]["channels"][0]["name"] == STATE
    raw = next(d for s, d in page.scripts if s.get("type"))
    assert not re.search("[<>&\u2028\u2029]", raw)


def test_one_validation_is_enough(validation, tmp_path):
    write_report({"only": validation}, tmp_path / "one.html")
    found = Page(tmp_path / "one.html")
    assert len(found.rows("Channel", "Unit", "Role")) == 1
    assert "1 fitted model, 2 test runs" in found.text
    assert (tmp_path / "one.html").stat().st_size < 6e6


def test_a_model_without_record_or_wall_times_is_shown(validation, tmp_path):
    runs = tuple(replace(r, recorded=replace(r.recorded, wall_time=None)) for r in validation.runs)
    bare = replace(validation, record={}, runs=runs, warnings=("mind the <gap>",))
    write_report({"bare": bare}, tmp_path / "bare.html")
    found = Page(tmp_path / "bare.html")
    assert "mind the <gap>" in found.text
    assert "no record of its fit" in found.text
    assert found.rows("Fitted model", "Variant")[0][0][-1] == "—"


def test_settings_data_and_versions_are_listed(page, validation):
    assert "linear.kind" in page.text
    assert validation.record["data"][0]["sha256"][:12] in page.text
    assert validation.record["versions"]["jax"] in page.text


def test_bad_calls_fail_in_a_sentence(validation, tmp_path):
    with pytest.raises(DfsmError, match="no validations were given"):
        write_report({}, tmp_path / "r.html")
    with pytest.raises(DfsmError, match="could not be written"):
        write_report({"a": validation}, tmp_path / "missing" / "r.html")
    with pytest.raises(DfsmError, match="is a folder"):
        write_report({"a": validation}, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        (None, "—"),
        (float("nan"), "—"),
        (0.0, "0"),
        (0.14159, "0.142"),
        (-9.996, "−10.0"),
        (1234.5, "1230"),
        (291655.4, "292\u202f000"),
        (1.25e-7, "1.25e−07"),
    ],
)
def test_numbers(given, shown):
    assert number(given) == shown


def test_elements_escape_all_but_markup():
    inner = element("b", "<&>", title='"><script>')
    assert inner == '<b title="&quot;&gt;&lt;script&gt;">&lt;&amp;&gt;</b>'
    assert element("p", inner, "<") == f"<p>{inner}&lt;</p>"


def test_embedded_json_is_inert_and_intact():
    given = {"</script>": "<!--&\u2028\u2029"}
    assert not re.search("[<>&\u2028\u2029]", embed(given))
    assert json.loads(embed(given)) == given


def test_the_terminal_shows_coverage_where_it_is_known(validation, capsys):
    names, units = zip(*((c.name, c.unit) for c in validation.channels), strict=True)
    grid = np.asarray(validation.models["multi-fidelity"].region.grid)
    given = Intervals(names, units, None, grid, np.ones((1, 3)), 0.875, ("c",), ("",))
    runs = []
    for share, r in zip((0.5, 0.75), validation.runs, strict=True):
        covered = replace(r.models["multi-fidelity"], coverage={STATE: share})
        runs.append(replace(r, models={**r.models, "multi-fidelity": covered}))
    found = replace(validation, intervals=given, runs=tuple(runs))
    print_validations({"shaded": found, "plain": validation})
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert next(r for r in rows if r and r[0] == "model")[-2:] == ["inside*", "promised"]
    assert next(r for r in rows if r and r[0] == "shaded")[-4:] == ["62.5", "%", "87.5", "%"]
    assert next(r for r in rows if r and r[0] == "plain")[-1] != "%"


def test_the_terminal_leaves_out_what_was_not_fitted(validation, capsys):
    fewer = {name: m for name, m in validation.models.items() if name != "nonlinear-only"}
    print_validations({"all": validation, "some": replace(validation, models=fewer)})
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    first, second = (next(r for r in rows if r and r[0] == label) for label in ("all", "some"))
    assert len(first) == len(second) + ("nonlinear-only" in validation.models)
