"""What a page carries to draw: small, and as exact as a screen can show."""

from __future__ import annotations

import base64
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dfsm as package
import fits
from conftest import Dfsm
from dfsm.core.bundle import MANIFEST
from dfsm.report.blobs import Blobs
from dfsm.report.figures import coarsest
from dfsm.report.first_screen import cautions, grades, verdict
from dfsm.report.model_card import card_article

REPORT = Path(package.__file__).parent / "report"


def unpacked(blob):
    """An array as the page's script reads it."""
    kind, offset, step, text = blob
    data = base64.b64decode(text)
    if kind == "f4":
        return offset + np.frombuffer(data, "<f4").astype(float)
    steps = np.frombuffer(data, "<u2").astype(float)
    exact = offset + step * np.where(steps == 65535, np.nan, steps)
    return 10**exact if kind == "log" else exact


def test_arrays_come_back_to_a_hair_of_their_range():
    time = np.linspace(0, 10, 501)
    wave = 1e9 + 0.01 * np.sin(time)
    holed = np.where(time > 9, np.nan, np.sin(time))
    gone = np.append(np.sin(time), 1e30)
    density = np.append(10.0**-time, [0.0])
    blobs = Blobs()
    drawn = [blobs.add_drawn(v) for v in (wave, holed, gone, np.full(5, 3.0), np.full(3, np.nan))]
    as_they_are = [blobs.add(v) for v in (wave, time)]
    (spectrum,) = (blobs.add_logarithmic(density),)
    back = [unpacked(b) for b in blobs.encoded]
    np.testing.assert_allclose(back[drawn[0]], wave, atol=0.02 / 65534)
    np.testing.assert_allclose(back[drawn[1]], holed, atol=2 / 65534)
    # One sample that ran away leaves the others what they were.
    np.testing.assert_allclose(back[drawn[2]][:-1], gone[:-1], atol=1e-6)
    np.testing.assert_array_equal(back[drawn[3]], np.full(5, 3.0))
    assert np.isnan(back[drawn[4]]).all()
    np.testing.assert_allclose(back[as_they_are[0]], wave, atol=1e-8)
    np.testing.assert_allclose(back[as_they_are[1]], time, rtol=1e-7)
    np.testing.assert_allclose(back[spectrum][:-1], density[:-1], rtol=1e-3)
    assert np.isnan(back[spectrum][-1])
    before = len(blobs.encoded)
    assert blobs.add_drawn(wave.copy()) == drawn[0]
    assert len(blobs.encoded) == before
    assert len(blobs.encoded[drawn[0]][3]) < 3 * len(wave)


def test_a_line_steps_over_samples_only_where_nobody_sees_it():
    time = np.arange(0, 102.45, 0.2)  # 513 samples
    slow, fast = np.sin(0.1 * time), np.sin(0.1 * time) + 0.2 * np.sin(4 * time)
    every = coarsest(slow)
    assert every >= 8
    assert (len(time) - 1) % every == 0
    error = np.interp(time, time[::every], slow[::every]) - slow
    assert np.abs(error).max() <= np.ptp(slow) / 360
    assert coarsest(fast) == 1
    assert coarsest(np.append(slow, 0.0)) == 1  # the last sample must stay
    assert coarsest(np.full(9, np.nan)) == 1


def test_the_page_takes_a_part_of_plotly_and_names_its_licence():
    text = (REPORT / "plotly-basic.min.js").read_text(encoding="utf-8")
    assert text.startswith("/**\n* plotly.js (basic - minified) v")
    assert len(text) < 1.3e6
    assert "MIT License" in (REPORT / "plotly-basic.LICENSE").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def validation():
    model, runs = fits.linear().model, fits.linear_runs()[:2]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return package.validate(package.compared(model, None), runs)


def test_the_first_screen_tells_the_verdict_and_every_warning_once(validation, tmp_path):
    assert grades(validation) == dict.fromkeys(("q", "v", "y"), "usable")
    assert "usable: q, v, y." in verdict({"one": validation})
    run = validation.runs[1]
    model = run.models["multi-fidelity"]
    poor = {n: replace(e, nrmse=0.9) for n, e in model.errors.items()}
    worse = replace(model, errors={**model.errors, "v": poor["v"], "y": poor["y"]})
    changed = replace(run, models={**run.models, "multi-fidelity": worse})
    half = replace(validation, runs=(validation.runs[0], changed))
    assert "usable: q; for trends only: v, y." in verdict({"half": half})
    many = {f"m{k}": half for k in range(3)} | {"good": validation}
    assert (
        "Of 12 signals of 4 fitted models, 6 usable and 6 for trends only; "
        "every signal of good is usable" in verdict(many)
    )
    box = cautions({"a": validation, "b": validation})
    assert box.count("<li>") == len(validation.warnings)
    assert box.count("<details") == 1
    assert "(a, b)" in box
    package.write_report(many, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert page.index("Of 12 signals") < page.index("verdict-plot") < page.index('caution"')
    assert page.index('caution"') < page.index('id="summary"')
    assert len(page) < 2e6


def test_a_model_card_tells_what_the_model_holds(tmp_path, dfsm: Dfsm):
    model = fits.linear().model
    record = model.provenance.record
    article = card_article(model, "cart")
    tables = {t.key: t for t in article.tables()}
    assert "usable: q, v, y" in article.lede
    assert [r[0] for r in tables["data"].rows] == [d["name"] for d in record["data"]]
    signals = {r[0]: r for r in tables["signals"].rows}
    assert signals["q"][3] == pytest.approx(float(model.region.low[model.signals.state_columns][0]))
    (errors,) = [c for c in article.figures()[0].panels[0].curves if c.name == "this model"]
    assert errors.x.tolist() == [v["nrmse"] for v in record["verdicts"]]
    assert record["versions"]["dfsm"] in article.sections[-1].paragraphs[0]
    bare = replace(model, provenance=type(model.provenance)({}))
    assert "validate it on runs of your own" in card_article(bare, "bare").sections[0].paragraphs[0]
    package.save(model, tmp_path / "cart")
    done = dfsm("report", tmp_path / "cart", "-o", tmp_path / "card.html")
    assert f"wrote {tmp_path / 'card.html'}" in done.out
    page = (tmp_path / "card.html").read_text(encoding="utf-8")
    assert "Model card: cart" in page
    # Scripts look parts up by their names.
    names = re.findall(r'<[a-z]+[^<>]* id="([^"]+)"', page)
    assert len(names) == len(set(names))
    into = dfsm("report", tmp_path / "cart", "-o", tmp_path / "cart" / MANIFEST)
    assert into.code == 2
