"""Results of Bladed, QBlade and WEC-Sim, and uniform winds, written here as their formats go."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from conftest import Dfsm, sentence
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.readers.uniform import UniformSettings, is_uniform, read_uniform
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind_field import with_field_wind
from dfsm.errors import DfsmError, DfsmWarning

TIME = 0.05 * np.arange(30)


# -- Bladed -------------------------------------------------------------------------------------

SIGNALS = [
    ("'Time from start'", "T", 10 + TIME),
    ("POW2", "P", 1e6 + 1e5 * np.sin(TIME)),
    ("'Rotor speed'", "A/T", 1 + 0.1 * np.cos(TIME)),
    ("'Shaft Mx'", "FL", 1e5 * TIME),
    ("'Yaw acceleration'", "A/TT", TIME**2),
]
CONTROL = np.stack([v for *_, v in SIGNALS], axis=1)
# Time, place, signal.
TOWER = np.arange(30 * 3 * 2, dtype=float).reshape(30, 3, 2) ** 2 / 7
KINDS = {"R*4": "<f4", "R*8": "<f8", "I*4": "<i4", "I*2": "<i2"}
TIME_AXIS = ["AXISLAB\t'Time'", "AXIUNIT\tT", "AXIMETH\t2", "MIN \t2.0000000E+000"]
TIME_AXIS += ["STEP\t5.0000001E-002"]


def bladed(
    folder: Path,
    number: str,
    values: np.ndarray,
    signals: list[str],
    axes: list[str],
    form: str = "R*4",
    access: str = "D",
    changed: tuple[str, str] = ("", ""),
) -> Path:
    """A header that breaks its long lines, and samples in text or binary."""
    sizes = values.shape[::-1]
    head = [f"FILE\trun.${number}", f"ACCESS\t{access}", f"FORM\t{'U' if access == 'D' else 'F'}"]
    head += ["RECL\t4", f"FORMAT\t{form}", "CONTENT\t'POWPROD'", f"NDIMENS  {len(sizes)}"]
    head += [f"DIMENS\t{'  '.join(map(str, sizes))}", "GENLAB\t'Some group'", *signals, *axes]
    head += ["NVARS\t0", "ULOADS   1.0   2.0", "   3.0   4.0", "MEAN  1.0 2.0"]
    header = folder / f"run.%{number}"
    header.write_text("\r\n".join(head).replace(*changed) + "\r\n", encoding="latin-1")
    data = folder / f"run.${number}"
    if access == "D":
        values.astype(KINDS[form]).tofile(data)
    else:
        np.savetxt(data, values.reshape(-1, values.shape[-1]), fmt="%15.7e")
    return header


def control(folder: Path, number: str = "04", **options) -> Path:
    names, units = ([s[i] for s in SIGNALS] for i in (0, 1))
    signals = ["VARIAB\t" + " ".join(names[:3]), " ".join(names[3:]), "VARUNIT\t" + " ".join(units)]
    return bladed(folder, number, options.pop("values", CONTROL), signals, TIME_AXIS, **options)


def tower(folder: Path, number: str = "25", **options) -> Path:
    signals = ["VARIAB   MYT 'Tower Fx'", "VARUNIT   FL  F"]
    place = options.pop("place", ["AXIVAL    -15.000  20.2000008", "   87.5"])
    axes = ["AXISLAB  'Tower station height'", "AXIUNIT   L", "AXIMETH  3", *place, *TIME_AXIS]
    return bladed(folder, number, TOWER, signals, axes, **options)


@pytest.mark.parametrize("access", ["D", "S"])
@pytest.mark.parametrize("form", ["R*4", "R*8", "I*4"])
def test_bladed_in_text_and_binary(tmp_path, access, form):
    whole = np.floor(CONTROL) if form == "I*4" else CONTROL
    path = control(tmp_path, values=whole, form=form, access=access)
    run = read(path)
    assert run.names == ("Time from start", "POW2", "Rotor speed", "Shaft Mx", "Yaw acceleration")
    assert [c.unit for c in run.channels] == ["s", "W", "rad/s", "N m", "rad/s^2"]
    np.testing.assert_allclose(run.time, 2 + TIME, rtol=0, atol=1e-12)  # 0.05, not 0.050000001
    np.testing.assert_allclose(run.values, whole, rtol=1e-7)
    assert read(path.with_suffix(".$04")).digest == run.digest
    steps = [c.step for c in run.channels]
    if (access, form) == ("S", "R*4"):
        # Eight digits: of numbers of some ten, of a million, of one.
        np.testing.assert_allclose(steps[:3], [1e-6, 0.1, 1e-7], rtol=0.1)
    elif access == "D":
        assert steps == [None] * 5


def test_bladed_at_several_places(tmp_path):
    for access in ("D", "S"):
        run = read(tower(tmp_path, access=access))
        assert run.names[:3] == ("MYT at -15 m", "Tower Fx at -15 m", "MYT at 20.2 m")
        np.testing.assert_allclose(run["Tower Fx at 87.5 m"], TOWER[:, 2, 1], rtol=1e-6)
        np.testing.assert_allclose(run.values, TOWER.reshape(30, 6), rtol=1e-6)
    named = tower(tmp_path, place=["AXITICK\t'Node 1' 'Node 2' ", "'Node 3'"])
    assert read(named).names[-1] == "Tower Fx at Node 3"


def test_a_project_of_bladed_is_all_its_groups(tmp_path):
    control(tmp_path)
    tower(tmp_path, access="S")
    other = ("AXISLAB\t'Time'", "AXISLAB\t'Step number'")
    control(tmp_path, "37", changed=other)
    control(tmp_path, "41", values=CONTROL[:7])
    project = tmp_path / "run.$PJ"
    project.write_text("<project/>")
    run = read(project)
    assert run.names[:5] == read(tmp_path / "run.%04").names
    assert run.names[5:] == read(tmp_path / "run.%25").names
    assert run.notes == (
        "run.%37 left out: its signals go over 'Step number'",
        "run.%41 left out: its times are not those of run.%04",
    )
    assert "go over 'Step number', expected a time series" in sentence(tmp_path / "run.%37")
    (tmp_path / "other.$PJ").write_text("<project/>")
    assert "no results over time lie beside the project" in sentence(tmp_path / "other.$PJ")


def test_a_run_of_bladed_that_ended_early(tmp_path):
    path = tower(tmp_path, access="S")
    data = tmp_path / "run.$25"
    lines = data.read_text().splitlines(keepends=True)
    data.write_text("".join(lines[:31])[:-4])
    run = read(path)
    np.testing.assert_allclose(run.values, TOWER[:10].reshape(10, 6), rtol=1e-6)
    assert run.notes == (
        "line 31 begins a time that not all 3 places have: left out",
        "10 times, the header announces 30: the run ended early",
    )
    data.write_text("".join(lines[:33])[:-4])
    assert "that record is left out" in read(path).notes[0]
    # A length that is not known before the end.
    assert len(read(control(tmp_path, changed=("DIMENS\t5  30", "DIMENS\t5  0")))) == 30


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (("FORMAT\tR*4", "FORMAT\tC*8"), "of type 'C*8', expected R*4, R*8, I*2, I*4"),
        (("FORMAT\tR*4", "FORMAT\tR*8"), "600 bytes, but its header announces 5 signals"),
        (("ACCESS\tD", "ACCESS\tX"), "ACCESS is 'X', expected D (binary) or S (text)"),
        (("ACCESS\tD\r\n", ""), "is no header of Bladed: ACCESS is missing"),
        (("DIMENS\t5  30", "DIMENS\t6  30"), "5 names and 5 units, but DIMENS announces 6"),
        (("DIMENS\t5  30", "DIMENS\t5  7  30"), "DIMENS is 5 7 30 for 1 axes"),
        (("DIMENS\t5  30", "DIMENS\t5  31"), "31 times of 4 bytes, which makes 620"),
        (("DIMENS\t5  30", "DIMENS\t5  " + "9" * 5000), "expected the number of signals"),
        (("STEP\t5.0000001E-002", "STEP\t0.0"), "STEP '0.0' of the axis 'Time' are no start"),
    ],
)
def test_headers_of_bladed_that_do_not_fit(tmp_path, changed, said):
    path = control(tmp_path, changed=changed)
    told = sentence(path)
    assert said in told
    assert str(tmp_path) in told


def test_samples_of_bladed_that_do_not_fit(tmp_path):
    path = control(tmp_path)
    data = tmp_path / "run.$04"
    data.write_bytes(data.read_bytes()[:-3])
    assert "597 bytes, but its header announces 5 signals at 1 place and 30 times" in sentence(path)
    data.unlink()
    assert "run.$04" in sentence(path)
    data.write_bytes(b"")
    assert "run.$04 is empty" in sentence(path)
    data.write_bytes(b"some")
    path.unlink()
    assert "run.%04" in sentence(data)
    path = tower(tmp_path, place=["MIN  0.0", "STEP 1.0"])
    path.write_text(path.read_text().replace("DIMENS\t2  3  30", f"DIMENS\t2  {10**11}  30"))
    assert "signals at one time are announced" in sentence(path)
    path = tower(tmp_path, place=["AXIVAL 1.0 2.0"])
    assert "2 places on the axis 'Tower station height', but DIMENS announces 3" in sentence(path)


# -- QBlade -------------------------------------------------------------------------------------


def qblade(path: Path, names: list[str], end: str = "\t\n") -> Path:
    """Two lines of titles, names and rows with a tab behind every cell, six digits."""
    head = "Results Output File created with QBlade on 31.08.2026 at 09:10:56\nTime: 8 m/s, NREL\n"
    table = np.stack([TIME, 0 * TIME + 0.05, 100 + 50 * TIME, 1e6 * np.cos(TIME)], axis=1)
    rows = ["\t".join(f"{v:.5E}" for v in row) + end for row in table]
    path.write_text(head + "\t".join(names) + end + "".join(rows))
    return path


def test_exports_of_qblade(tmp_path):
    names = ["Time [s]", "Timestep [s]", "X_g Mom. TWR Bot. (1) [Nm]", "Aerodynamic Power [kW]"]
    for spelled in (names, [n.replace(" ", "_") for n in names]):
        run = read(qblade(tmp_path / "a.txt", spelled))
        assert [c.unit for c in run.channels] == ["s", "Nm", "kW"]
        assert run.names[1].replace("_", " ") == "X g Mom. TWR Bot. (1)"
        np.testing.assert_allclose(run.time, TIME, atol=1e-12)
        np.testing.assert_allclose(run.values[:, 2], 1e6 * np.cos(TIME), rtol=1e-5)
        # Six digits of numbers that are mostly between 1e5 and 1e6.
        assert 0.5 < (run.channels[2].step or 0) < 10
    cut = tmp_path / "cut.txt"
    cut.write_text((tmp_path / "a.txt").read_text()[:-9])
    run = read(cut)
    assert len(run) == 29
    assert any("that record is left out" in note for note in run.notes)


# -- WEC-Sim ------------------------------------------------------------------------------------


def six(k: int) -> np.ndarray:
    return np.sin(np.outer(TIME, k + np.arange(6)))


def part(name: str, **matrices: np.ndarray) -> dict:
    return {"name": name, "time": TIME[:, None], **matrices}


def structs(*parts: dict) -> np.ndarray:
    return np.array([[tuple(p.values()) for p in parts]], dtype=[(k, object) for k in parts[0]])


def test_the_output_of_wecsim_saved_as_a_struct(tmp_path):
    path = tmp_path / "a.mat"
    none = np.empty((0, 0))
    bodies = [
        part(
            n, position=six(k), velocity=six(k + 1), forceTotal=six(k + 2), cellPressures_time=none
        )
        for k, n in ((1, "float"), (4, "spar"))
    ]
    ends = np.arange(9.0)[:, None]
    wave = {"type": "irregular", "time": TIME[:, None], "elevation": np.cos(TIME)[:, None]}
    output = {
        "bodies": structs(*bodies),
        "cables": {},
        "moorDyn": {"Lines": {"Time": ends, "FairTen1": ends}},
        "ptos": part("p", forceActuation=six(2), powerInternalMechanics=six(3)),
        "wave": wave,
    }
    savemat(path, {"output": output})
    run = read(path)
    units = {c.name: c.unit for c in run.channels}
    assert units["bodies_1.position_3"] == units["wave.elevation"] == "m"
    assert [units[f"bodies_2.velocity_{i}"] for i in (3, 4)] == ["m/s", "rad/s"]
    assert [units[f"ptos.forceActuation_{i}"] for i in (1, 6)] == ["N", "N m"]
    assert units["ptos.powerInternalMechanics_6"] == "W"
    np.testing.assert_array_equal(run["bodies_2.forceTotal_5"], six(6)[:, 4])
    assert [n.split(" left out")[0] for n in run.notes] == [
        "'moorDyn.Lines.Time'",
        "'moorDyn.Lines.FairTen1'",
    ]
    # Other matrices of six have no units that anybody knows.
    savemat(path, {"float": part("float", position=six(1))})
    assert {c.unit for c in read(path).channels} == {""}


def test_objects_of_wecsim_are_told_how_to_save(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"k": 1.0})
    raw = path.read_bytes()
    # An opaque array as MATLAB writes it: flags, and three names.
    texts = [struct.pack("<II", 1, len(t)) + t.ljust(8, b"\0") for t in (b"output", b"MCOS")]
    body = struct.pack("<IIII", 6, 8, 17, 0) + b"".join(texts)
    path.write_bytes(raw + struct.pack("<II", 14, len(body)) + body)
    assert "'output' is an object that only MATLAB reads: save it as a struct" in sentence(path)


# -- uniform winds ------------------------------------------------------------------------------

HUB, RADIUS = 150.0, 120.0
WIND = """! made by a test
! Time  Speed  Dir  Vert  HShr  VShr  VLin  Gust   # more
  0.0    8.0   0.0  0.0   0.0   0.2   0.0   0.0
 10.0   10.0  10.0  0.0   0.1   0.2   0.05  2.0   ! a gust
 10.0   12.0 350.0  0.0   0.1   0.0   0.05  0.0
 20.0   12.0 350.0  0.0   0.1   0.0   0.05  0.0
"""


def inflow(t: float, y: np.ndarray, z: np.ndarray, length: float = 240.0) -> np.ndarray:
    """Wind along x of the file above before and behind its jump, formula by formula."""
    part = min(max(t, 0.0), 10.0) / 10
    speed, turn, power, gust = 8 + 2 * part, np.deg2rad(10 * part), 0.2, 2 * part
    sideways, upwards = 0.1 * part, 0.05 * part
    if t >= 10:
        speed, turn, power, gust, sideways, upwards = 12.0, np.deg2rad(-10.0), 0.0, 0.0, 0.1, 0.05
    shear = sideways * y * np.cos(turn) / length + upwards * (z - HUB) / length
    return (speed * (z / HUB) ** power + speed * shear + gust) * np.cos(turn)


def averages(t: float) -> list[float]:
    """Mean over the disk and its slopes, by rings of points that stand for equal areas."""
    r = RADIUS * np.sqrt((np.arange(200) + 0.5) / 200)[:, None]
    angle = 2 * np.pi * np.arange(64) / 64
    y, z = r * np.sin(angle), HUB + r * np.cos(angle)
    u = inflow(t, y, z)
    up, side = (z - HUB) / RADIUS, y / RADIUS
    return [u.mean(), (u * up).mean() / (up**2).mean(), (u * side).mean() / (side**2).mean()]


def a_run(stop: float = 30.0) -> Trajectory:
    time = np.linspace(0.0, stop, 61)
    return Trajectory(time, np.sin(time)[:, None], (Channel("q", "m"),), name="run")


def test_a_uniform_wind_over_the_rotor(tmp_path):
    path = tmp_path / "gust.wnd"
    path.write_text(WIND)
    with pytest.warns(DfsmWarning, match="blows up to 10 deg sideways: the signals hold what is"):
        wind = read_uniform(path, UniformSettings(hub_height=HUB))
    run = a_run()
    wide = with_field_wind(run, wind.over(run.time, RADIUS), RADIUS, 1)
    # Between lines, at the jump, and behind the last line.
    for i, t in enumerate(run.time):
        at = [wide[n][i] for n in ("RotWind", "RotShearV", "RotShearH")]
        np.testing.assert_allclose(at, averages(t), atol=0.02)
    # A ring of 15 m, where every part is nearly straight.
    angle = 2 * np.pi * np.arange(64) / 64
    u = inflow(7.5, 15 * np.sin(angle), HUB + 15 * np.cos(angle))
    first = [u.mean(), 2 * (u * np.cos(angle)).mean(), 2 * (u * np.sin(angle)).mean()]
    at = [wide[n][15] for n in ("U_r015", "C1_r015", "S1_r015")]
    np.testing.assert_allclose(at, first, atol=2e-3)


@pytest.mark.parametrize(
    ("directions", "told"), [((355, 364), 5), ((350, 375), 15), ((-4, 8), 8), ((725, 718), 5)]
)
def test_directions_that_wrap_are_told_as_they_blow(tmp_path, directions, told):
    path = tmp_path / "turn.wnd"
    path.write_text("".join(f"{9 * k} 8 {d} 0 0 0 0 0\n" for k, d in enumerate(directions)))
    with pytest.warns(DfsmWarning, match=f"blows up to {told} deg sideways"):
        wind = read_uniform(path, UniformSettings(hub_height=HUB))
    assert abs(np.ptp(wind.columns[:, 1])) == abs(directions[1] - directions[0])


def test_uniform_winds_with_upflow_and_other_references(tmp_path):
    path = tmp_path / "up.hh"
    path.write_text("0,9,0,1.0,0,0,0.2,0,30\n")
    settings = UniformSettings(hub_height=HUB, reference_height=100.0, reference_length=90.0)
    with pytest.warns(DfsmWarning, match="blows upwards"):
        wind = read_uniform(path, settings)
    (u,) = wind.over(np.zeros(1), RADIUS).blocks()
    at_hub = (9 * (1 + 0.2 * (HUB - 100) / 90)) * np.cos(np.pi / 6) - 0.5
    np.testing.assert_allclose(u[0, 20], at_hub, rtol=1e-12)


def test_the_command_takes_uniform_winds(tmp_path, dfsm: Dfsm):
    path = tmp_path / "step.wnd"
    path.write_text("0 8 0 0 0 0.2 0 0\n99 8 0 0 0 0.2 0 0\n")
    write_table(a_run(), tmp_path / "run.csv")
    command = ("wind", path, tmp_path / "run.csv", "--radius", RADIUS, "-o", tmp_path / "new")
    assert "give its height with --hub-height" in dfsm(*command).sentence
    command = (*command, "--hub-height", HUB, "--harmonics", 0)
    assert "--shear is for a Mann box" in dfsm(*command, "--shear", 0.1).sentence
    box = ("--box", 8, 8, 8, 1, 1, 1, "--reference-height", 90)
    assert "--reference-height is for a uniform wind" in dfsm(*command, *box).sentence
    result = dfsm(*command)
    assert result.code == 0
    assert "hub at 150 m, as told" in result.out
    mean = averages(0.0)[0]  # the same wind
    np.testing.assert_allclose(read(tmp_path / "new" / "run.parquet")["RotWind"], mean, atol=2e-3)
    assert dfsm(*command, "--reference-height", 75).code == 0
    written = read(tmp_path / "new" / "run.parquet")
    np.testing.assert_allclose(written["RotWind"], mean * 2**0.2, atol=2e-3)
    assert "of radius 120.0 m around a hub at 100 m" in dfsm(*command, "--hub-height", 100).sentence


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0 8 0 0 0 0.2\n", "6 columns, a uniform wind has 8 or 9 (time, speed, direction, "),
        ("0 8 0 0 0 0.2 0 0\n1 8 0 0 0 0.2 0\n", "line 2: 7 values, but the header names 8"),
        ("0 8 0 0 0 0.2 0 0\n1 8 0 x 0 0.2 0 0\n", "line 2: 'x' in column 4 is no number"),
        ("0 8 0 0 0 0.2 0 0\n\n1 nan 0 0 0 0 0 0\n", "line 3: a value is missing or no wind"),
        ("0 8 0 0 0 0.2 0 0\n1 8000 0 0 0 0 0 0\n", "speeds below 1000 m/s"),
        ("5 8 0 0 0 0.2 0 0\n1 8 0 0 0 0 0 0\n", "line 2: its time 1 s comes after 5 s"),
    ],
)
def test_uniform_winds_that_are_none(tmp_path, text, said):
    path = tmp_path / "a.wnd"
    path.write_text(text)
    assert is_uniform(path)
    with pytest.raises(DfsmError) as caught:
        read_uniform(path, UniformSettings(hub_height=HUB))
    assert said in str(caught.value)
    with pytest.raises(DfsmError, match="reference_length is -1, expected a positive number in m"):
        UniformSettings(hub_height=HUB, reference_length=-1)
    assert not is_uniform(Path(__file__))


def test_a_uniform_wind_cut_in_its_only_row(tmp_path):
    path = tmp_path / "a.wnd"
    path.write_text("! Time Speed Dir Vert HShr VShr VLin Gust\n0.0 8.0 0.0 0.0 0.0 0.2 0.00 -")
    with pytest.raises(DfsmError, match="its only row is incomplete"):
        read_uniform(path, UniformSettings(hub_height=HUB))
