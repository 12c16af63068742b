"""Bladed-style libraries in processes of their own: a small one in C, and how they end."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from decks import write_deck
from dfsm.controllers.bladed import BladedLibrary
from dfsm.controllers.controller import Controller
from dfsm.errors import DfsmError, DfsmWarning

COMPILER = shutil.which("cc")
compiled = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("library") / "libsmall.so"
    source = Path(__file__).with_name("bladed.c")
    subprocess.run([str(COMPILER), "-shared", "-fPIC", "-o", path, source], check=True)
    return path


def small(library: Path, **settings) -> BladedLibrary:
    channels = {"wind": "Wind1VelX", "power": ("GenPwr", "MW"), "rotor_speed": ("Rot", "rad/s")}
    return BladedLibrary(library, interval=0.1, channels=channels, **settings)


@compiled
def test_measurements_and_commands_in_their_units(library):
    controller = small(library)
    assert isinstance(controller, Controller)
    assert controller.measurements == ("GenSpeed", "Wind1VelX", "GenPwr", "Rot")
    assert controller.measurement_units == ("rpm", "m/s", "MW", "rad/s")
    assert controller.commands == ("GenTq", "BldPitch1")
    # GenSpeed rpm, wind, power MW, rotor speed rad/s; torque kN m, pitch deg.
    state = controller.start(np.array([30.0, 10.0, 2.0, 3.0]), np.array([7.0, 1.0]))
    state, commands = controller.step(state, np.array([30.0, 10.0, 2.0, 3.0]), 0.0)
    # The library answers 0.02 rad, and torque at the start + W / 1000 + rad/s.
    np.testing.assert_allclose(commands, [(7000 + 2000 + 3) / 1e3, np.rad2deg(0.02)], rtol=1e-6)
    assert f"started at {np.float32(np.pi):.5f}" in state.printed()
    state.close()


@compiled
def test_libraries_share_nothing_and_go_forward_only(library):
    controller = small(library)
    here, there = (controller.start(np.ones(4), np.array([t, 0.0])) for t in (1.0, 2.0))
    first, (torque, _) = controller.step(here, np.ones(4), 0.1)
    assert torque == pytest.approx((1000 + 1000 + 1) / 1e3)
    assert controller.step(there, np.ones(4), 0.1)[1][0] == pytest.approx((2000 + 1000 + 1) / 1e3)
    with pytest.raises(DfsmError, match=r"1 calls ahead of the state at 0\.2 s: it cannot go back"):
        controller.step(here, np.ones(4), 0.2)
    # Without power and rotor's speed among the channels they follow from torque and speed.
    plain = BladedLibrary(library, interval=0.1, gearbox=2.0, efficiency=0.5)
    state = plain.start(np.array([60 / np.pi, 0.0]), np.array([3.0, 0.0]))
    assert plain.step(state, np.array([60 / np.pi, 0.0]), 0.0)[1][0] == pytest.approx(
        (3000 + 2 * 3000 * 0.5 / 1000 + 1.0) / 1e3
    )
    folder = first.process.folder
    first.close()
    assert not folder.exists()


@compiled
@pytest.mark.parametrize(
    ("wind", "told"),
    [
        (40.0, "refused at 12.5 s: wind is too strong$"),
        (42.0, r"ended the process that it ran in at 12.5 s \(SIGSEGV"),
        (43.0, r"at 12.5 s \(exit code 2, Fortran runtime error: no such file\)"),
        (44.0, "sets BldPitch1 to nan at 12.5 s"),
        (np.nan, "Wind1VelX is nan at 12.5 s"),
    ],
)
def test_ends_are_one_sentence_with_the_time(library, wind, told):
    controller = small(library)
    state = controller.start(np.ones(4), np.zeros(2))
    with pytest.raises(DfsmError, match=told):
        controller.step(state, np.array([1.0, wind, 1.0, 1.0]), 12.5)
    if wind in (40.0, 42.0):
        with pytest.raises(DfsmError, match="has ended before 13 s: start it again"):
            controller.step(state, np.ones(4), 13.0)


@compiled
def test_warnings_contactor_and_farewell(library, tmp_path):
    (tmp_path / "own.in").write_text("input of a library that is not ROSCO's\n")
    controller = small(library, discon=tmp_path / "own.in")
    state = controller.start(np.ones(4), np.zeros(2))
    with pytest.warns(DfsmWarning, match="at 1 s: wind is strong"):
        state, _ = controller.step(state, np.array([1.0, 41.0, 1.0, 1.0]), 1.0)
    state, commands = controller.step(state, np.array([1.0, 45.0, 1.0, 1.0]), 2.0)
    assert commands[0] == 0.0
    state, commands = controller.step(state, np.ones(4), 2e5)
    assert commands[0] == pytest.approx(len(str(tmp_path / "own.in")) / 1e3)
    state.close()
    # It works in the folder of its input.
    assert (tmp_path / "ended.txt").read_text() == "4"


@compiled
def test_nothing_is_left_of_a_state_that_is_forgotten(library):
    state = small(library).start(np.ones(4), np.zeros(2))
    child, folder = state.process.popen.pid, state.process.folder
    del state
    until = time.monotonic() + 5
    while folder.exists() and time.monotonic() < until:
        time.sleep(0.01)
    assert not folder.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_what_cannot_be_loaded_is_one_sentence(tmp_path):
    text = tmp_path / "libdiscon.so"
    text.write_text("no library")
    with pytest.raises(DfsmError, match=r"libdiscon.so cannot be loaded \(.*with a procedure"):
        BladedLibrary(text, interval=0.1).start(np.ones(2), np.zeros(2))
    with pytest.raises(DfsmError, match=r"none\.so: no such file"):
        BladedLibrary(tmp_path / "none.so", interval=0.1)
    deck = write_deck(tmp_path, PerfFileName='"gone.txt"')
    with pytest.raises(DfsmError, match=r"PerfFileName: .*gone.txt: no such file"):
        BladedLibrary(text, deck, interval=0.1)
    with pytest.raises(DfsmError, match="there is no role 'winds'; did you mean 'wind'"):
        BladedLibrary(text, interval=0.1, channels={"winds": "Wind1VelX"})
    with pytest.raises(DfsmError, match="wind 'Wind' is in 'kN', which is no unit like m/s"):
        BladedLibrary(text, interval=0.1, channels={"wind": ("Wind", "kN")})
