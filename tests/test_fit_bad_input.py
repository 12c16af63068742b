"""What `fit` refuses or warns of, in one sentence."""

from __future__ import annotations

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import fits
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI
from dfsm.models.dfsm import DFSM
from fits import LINEAR, SECOND, TIME
from systems import (
    OSCILLATOR,
    SPRING,
    System,
)


@pytest.fixture
def linear_runs():
    return fits.linear_runs()


@pytest.fixture
def duffing_runs():
    return fits.duffing_runs()


def decision(model: DFSM, name: str) -> dict:
    return next(r for r in model.provenance.record["rows"] if r["name"] == name)


# -- bad input ----------------------------------------------------------------------------------


def changed(run: Trajectory, name: str, values) -> Trajectory:
    new = run.values.copy()
    new[:, run.column(name)] = values
    return replace(run, values=new)


def test_a_constant_control_is_refused(linear_runs):
    runs = [changed(r, "u", 2.5) for r in linear_runs]
    with pytest.raises(DfsmError, match=r"control 'u' is 2\.5 throughout all 4 runs"):
        fit(runs, LINEAR)
    # Different levels in different runs are information.
    runs = [changed(r, "u", float(i)) for i, r in enumerate(linear_runs)]
    assert fit(runs, replace(LINEAR, corrective=NoCorrection())).model.f.coefficients.shape[2] == 4


def test_nan_names_file_channel_and_time(linear_runs):
    values = linear_runs[2]["y"].copy()
    values[17] = np.nan
    runs = [*linear_runs[:2], changed(linear_runs[2], "y", values)]
    with pytest.raises(DfsmError, match=r"run0_2\.csv: channel 'y' has 1 NaN .* at 0\.85 s"):
        fit(runs, LINEAR)
    # In a channel that the fit does not read it does no harm.
    assert fit(runs, replace(LINEAR, outputs=(), corrective=NoCorrection())).model.g is None


def test_units_that_differ_are_refused(linear_runs):
    odd = replace(
        linear_runs[1],
        channels=tuple(
            replace(c, unit="kN") if c.name == "w" else c for c in linear_runs[1].channels
        ),
    )
    with pytest.raises(DfsmError, match=r"channel 'w' is in '(m/s|kN)' in .*csv but in '"):
        fit([linear_runs[0], odd], LINEAR)


def test_a_gap_in_the_window_is_warned_of(linear_runs):
    def cut(run):
        keep = (run.time < 10) | (run.time > 11.2)
        return replace(run, time=run.time[keep], values=run.values[keep])

    runs = [cut(linear_runs[0]), *linear_runs[1:]]
    choices = replace(LINEAR, corrective=NoCorrection())
    with pytest.warns(
        DfsmWarning, match=r"^runs/run0_0\.csv: there is a gap of 1\.25 s after 9\."
    ) as told:
        model = fit(runs, choices).model
    assert len(told) == 1
    assert "warning: runs/run0_0.csv: there is a gap" in model.summary()
    with pytest.warns(DfsmWarning, match=r"without it \(2 of the 4 runs have gaps\)$"):
        fit([cut(runs[1]), *runs[:1], *runs[2:]], choices)
    fit(runs, replace(choices, start=13.5))


def test_a_parameter_with_one_value_in_all_runs_is_warned_of():
    runs = SPRING.many(2, [(0, 3), (3.0, 0)], TIME, seed=10)
    choices = replace(
        LINEAR, disturbances=(), parameters=("k",), corrective=NoCorrection(), nonlinear_only=False
    )
    with pytest.warns(DfsmWarning, match="^input 'k' has the same value in all samples") as told:
        model = fit(runs, choices).model
    assert len(told) == 1
    np.testing.assert_array_equal(np.asarray(model.f.coefficients)[0, :, -1], 0)
    assert np.isfinite(model.provenance.record["condition"])


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (-0.3, "a correction explains nothing on data left out of its training"),
        (0.0004, "a correction explains nothing on data left out of its training"),
        (0.004, "a correction explains only 0.4% of its variance in cross-validation"),
    ],
)
def test_a_correction_that_is_not_worthwhile(duffing_runs, monkeypatch, share, text):
    def trained(inputs, residuals, *_):
        return SimpleNamespace(explained=np.full(residuals.shape[1], share), detail="")

    monkeypatch.setattr("dfsm.fitting.gate.fit_corrective", trained)
    choices = replace(LINEAR, states=SECOND, outputs=("y", "z"), nonlinear_only=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        model = fit(duffing_runs, choices).model
    assert model.e is model.e_g is None
    for name in ("q_ddot", "y"):
        assert decision(model, name)["decision"].endswith(text)


def test_a_channel_in_two_roles_is_refused(linear_runs):
    with pytest.raises(DfsmError, match="'u' is listed as control and as disturbance"):
        fit(linear_runs, replace(LINEAR, disturbances=("w", "u")))
    with pytest.raises(DfsmError, match="'q' is listed as state and as control"):
        fit(linear_runs, replace(LINEAR, controls=("q",)))
    with pytest.raises(DfsmError, match=r"'q' is a state, .* leave it out of outputs"):
        fit(linear_runs, replace(LINEAR, outputs=("y", "q")))


def test_an_input_may_also_be_an_output(linear_runs):
    model = fit(linear_runs, replace(LINEAR, outputs=("u",))).model
    assert model.g is not None
    np.testing.assert_allclose(model.g.coefficients[0], [[1, 0, 0, 0]], atol=1e-8)


def test_an_unknown_channel_names_the_file_and_near_ones(linear_runs):
    long = replace(
        linear_runs[0],
        channels=(Channel("PtfmPitch", "deg"), *linear_runs[0].channels[1:]),
    )
    with pytest.raises(DfsmError, match=r"run0_0\.csv: no channel 'PtfmPtich'; did you mean 'Ptfm"):
        fit([long], replace(LINEAR, states=(StateSpec(name="PtfmPtich"),)))


def test_bad_schedules_are_refused(linear_runs):
    with pytest.raises(DfsmError, match=r"linear\.schedule 'wind' is not an input .* u, w, q, v"):
        fit(linear_runs, replace(LINEAR, linear=LPV(schedule="wind")))


def test_a_window_longer_than_a_run_is_refused(linear_runs):
    with pytest.raises(DfsmError, match=r"run0_\d\.csv: runs from 0 s to 30 s, shorter than"):
        fit(linear_runs, replace(LINEAR, start=50.0))


def test_the_window_selects_the_samples(linear_runs):
    model = fit(linear_runs, replace(LINEAR, start=10.0, stop=20.0)).model
    inside = np.concatenate([r.window(10, 20)["u"] for r in linear_runs])
    np.testing.assert_allclose(model.region.mean[0], inside.mean(), rtol=1e-12)
    np.testing.assert_allclose([model.region.low[0], model.region.high[0]],
                               [inside.min(), inside.max()])  # fmt: skip


def test_fewer_samples_than_unknowns_is_refused(linear_runs):
    with pytest.raises(DfsmError, match="3 samples for 5 unknowns"):
        fit(linear_runs[:1], replace(LINEAR, start=1.0, stop=1.1))


def test_confounded_inputs_and_instability_are_warned_of(linear_runs):
    runs = [changed(r, "w", 2 * r["u"]) for r in linear_runs]
    with pytest.warns(DfsmWarning, match="cannot tell these inputs apart: (u, w|w, u)"):
        model = fit(runs, replace(LINEAR, corrective=NoCorrection())).model
    assert "warning: the runs cannot tell" in model.summary()
    falling = System(
        OSCILLATOR.states,
        OSCILLATOR.exogenous,
        OSCILLATOR.outputs,
        f=lambda x, v: np.stack([x[1], 0.09 * x[0] + v[0] + v[1]]),
        g=OSCILLATOR.g,
    )
    runs = falling.many(3, [(0, 0.1), (0, 0.1)], np.arange(0, 10, 0.02), spread=0.1)
    with pytest.warns(DfsmWarning, match=r"unstable at its only point \(fastest growth 0\.3 1/s\)"):
        assert "UNSTABLE" in fit(runs, replace(LINEAR, linear=LTI())).model.summary()
