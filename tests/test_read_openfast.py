"""Binary and text OpenFAST files, against a writer of our own and against raw bytes."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from benchmarks.outb import encode, outb_bytes, smooth_run, write_outb
from dfsm.data.readers import read, read_all
from dfsm.data.readers.openfast import read_openfast
from dfsm.data.wind import undisturbed_rotor_wind, wind_warning
from dfsm.errors import DfsmError

EXAMPLES = Path(__file__).parents[1] / "examples" / "iea15"
REAL = EXAMPLES / "iea15_2dof_12mps_s09.outb"
NAMES, UNITS = ("GenTq", "PtfmPitch", "GenPwr"), ("kN-m", "deg", "kW")
quick = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


# -- binary -------------------------------------------------------------------------------------


@pytest.mark.parametrize("format_id", [1, 2, 3, 4])
@pytest.mark.parametrize("suffix", [".outb", ".out"])
def test_binary_formats_give_the_written_samples(tmp_path, format_id, suffix):
    time, values = smooth_run()
    path = write_outb(tmp_path / f"a{suffix}", time, values, NAMES, UNITS, format_id=format_id)
    run = read(path)
    assert run.names == NAMES
    assert tuple(c.unit for c in run.channels) == UNITS
    assert run.name == "a"
    assert run.source == str(path)
    assert run.notes == ()
    np.testing.assert_allclose(run.time, time, rtol=0, atol=1e-9)
    if format_id == 3:
        assert np.array_equal(run.values, values)
        assert all(c.step is None for c in run.channels)
    else:
        scales, offsets, codes = encode(values)
        exact = (codes - offsets.astype(float)) / scales.astype(float)
        np.testing.assert_allclose(run.values, exact, rtol=1e-15)
        steps = np.array([c.step for c in run.channels])
        np.testing.assert_allclose(steps, 1 / scales.astype(float), rtol=1e-9)
        # half a step, and the rounding of the single-precision offset
        slack = 0.5 + 2 * np.spacing(np.abs(offsets))
        assert (np.abs(run.values - values) <= steps * slack).all()


def test_packed_time_of_format_1_may_be_irregular(tmp_path):
    time = np.array([0.0, 0.1, 0.3, 0.35, 2.0])
    path = write_outb(tmp_path / "a.outb", time, np.outer(time, [1, 2]), "ab", "ss", format_id=1)
    run = read_openfast(path)
    np.testing.assert_allclose(run.time, time, atol=2 / 2**31)
    assert run.time_step is None


@quick
@given(
    format_id=st.sampled_from([1, 2, 3, 4]),
    values=st.lists(
        st.lists(st.integers(-(10**9), 10**9), min_size=2, max_size=2), min_size=2, max_size=8
    ),
)
def test_any_samples_survive_to_the_quantisation_step(tmp_path, format_id, values):
    array = np.array(values) / 1000
    time = 0.5 * np.arange(len(array))
    path = write_outb(tmp_path / "a.outb", time, array, "ab", ["m", "s"], format_id=format_id)
    run = read_openfast(path)
    if format_id == 3:
        assert np.array_equal(run.values, array)
        return
    scales, offsets, _ = encode(array)
    # half a step, and the rounding of the single-precision offset that the format cannot avoid
    tolerance = (0.5 + 2 * np.spacing(np.abs(offsets))) / scales
    assert (np.abs(run.values - array) <= tolerance).all()


def test_wide_names_constant_channel_and_unit_cut_off(tmp_path):
    time, values = smooth_run()
    values[:, 1] = 7.0
    names = ("AVeryLongChannelNameOfFASTFarm", "Still", "C")
    path = write_outb(
        tmp_path / "a.outb", time, values, names, ("m", "-", ""), format_id=4, width=32
    )
    run = read_openfast(path)
    assert run.names == names
    assert run.channel("Still").step is None
    assert (run["Still"] == 7).all()
    assert [c.unit for c in run.channels] == ["m", "-", ""]
    path = write_outb(tmp_path / "b.outb", time, values, "abc", ["deg/kN-m/s", "m", "m"])
    assert read_openfast(path).channels[0].unit == "deg/kN-m/"


def test_a_channel_without_usable_scale_is_nan_and_told(tmp_path):
    time, values = smooth_run()
    raw = bytearray(outb_bytes(time, values, NAMES, UNITS))
    raw[26:30] = struct.pack("<f", 0.0)
    raw[30:34] = struct.pack("<f", float("nan"))
    (tmp_path / "a.outb").write_bytes(raw)
    run = read_openfast(tmp_path / "a.outb")
    assert np.isnan(run["GenTq"]).all()
    assert np.isnan(run["PtfmPitch"]).all()
    assert np.isfinite(run["GenPwr"]).all()
    assert len(run.notes) == 2
    assert "no usable scale" in run.notes[0]
    with pytest.raises(DfsmError, match="'GenTq' has 50 NaN"):
        run.require_finite()


def test_invalid_and_duplicated_channels(tmp_path):
    time, values = smooth_run()
    table = np.column_stack([values, values[:, 0], -values[:, 1], values, values[:, 1]])
    names = ("GenTq", "A", "B", "GenTq", "A", "Invalid", "C", "Invalid", "A")
    units = ("kN-m", "m", "m", "kN-m", "m", "", "INVALID", "", "m")
    run = read_openfast(write_outb(tmp_path / "a.outb", time, table, names, units, format_id=3))
    assert run.names == ("GenTq", "A", "B", "A#2")
    assert np.array_equal(run["A#2"], -values[:, 1])
    assert any("3 channels marked Invalid left out (number 6, 7, 8)" in n for n in run.notes)
    assert any("'GenTq' stands twice with the same data" in n for n in run.notes)
    assert any("called 'A#2'" in n for n in run.notes)
    only = write_outb(tmp_path / "b.outb", time, values[:, :1], ["Invalid"], [""])
    with pytest.raises(DfsmError, match="no channel besides time"):
        read_openfast(only)


def test_a_new_name_never_takes_an_existing_one(tmp_path):
    time, values = smooth_run()
    path = write_outb(tmp_path / "a.outb", time, values, ("A", "A", "A#2"), ("m", "m", "m"))
    assert read_openfast(path).names == ("A", "A#3", "A#2")


def test_a_bundled_file_against_its_raw_bytes():
    raw = REAL.read_bytes()
    width, count, samples = struct.unpack_from("<hii", raw, 2)
    start, step = struct.unpack_from("<dd", raw, 12)
    scales = np.frombuffer(raw, "<f4", count, 28).astype(float)
    offsets = np.frombuffer(raw, "<f4", count, 28 + 4 * count).astype(float)
    at = 28 + 8 * count
    at += 4 + struct.unpack_from("<i", raw, at)[0]
    names = [raw[at + i * width : at + (i + 1) * width].decode().strip() for i in range(count + 1)]
    at += 2 * (count + 1) * width
    codes = np.frombuffer(raw, "<i2", offset=at).reshape(samples, count)
    run = read_openfast(REAL)
    assert list(run.names) == names[1:]
    assert run.channel("PtfmRAyt").unit == "deg/s^2"
    assert np.array_equal(run.values, (codes - offsets) / scales)
    np.testing.assert_allclose(run.time, start + step * np.arange(samples), rtol=0, atol=1e-12)
    np.testing.assert_allclose([c.step for c in run.channels], 1 / scales, rtol=1e-9)
    assert run.time_step == pytest.approx(0.05)


# -- bad binary files ---------------------------------------------------------------------------


def good_bytes(format_id: int) -> bytes:
    return outb_bytes(*smooth_run(4), NAMES, UNITS, format_id=format_id)


def write_good(folder: Path) -> Path:
    (folder / "good.outb").write_bytes(good_bytes(4))
    return folder / "good.outb"


def expect(path: Path, raw: bytes, match: str) -> None:
    path.write_bytes(raw)
    with pytest.raises(DfsmError, match=match) as caught:
        read_openfast(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_headers_are_sentences(tmp_path):
    path = tmp_path / "bad.outb"
    raw = good_bytes(4)
    expect(path, b"", "is empty")
    expect(path, struct.pack("<h", 7) + raw[2:], "format id is 7, expected 1, 2, 3 or 4")
    expect(path, b"Time  GenTq\n(s) (kN-m)\n0 1\n1 2\n", "format id")
    expect(path, raw[:2] + struct.pack("<h", -3) + raw[4:], "name width of -3")
    expect(path, raw[:2] + struct.pack("<h", 30000) + raw[4:], "name width of 30000")
    expect(path, raw[:4] + struct.pack("<i", -1) + raw[8:], "number of channels of -1")
    expect(path, raw[:4] + struct.pack("<i", 2**30) + raw[8:], "end inside the header")
    expect(path, raw[:8] + struct.pack("<i", -5) + raw[12:], "number of samples of -5")
    expect(path, raw[:8] + struct.pack("<i", 1) + raw[12:], "number of samples of 1")
    expect(path, raw[:8] + struct.pack("<i", 5) + raw[12:], "5 samples, which makes")
    expect(path, raw[:20] + struct.pack("<d", 0.0) + raw[28:], "time step 0 s")
    expect(path, raw[:12] + struct.pack("<d", float("nan")) + raw[20:], "start time nan")
    at = 28 + 8 * 3
    expect(path, raw[:at] + struct.pack("<i", -2) + raw[at + 4 :], "description length of -2")
    expect(path, raw[:-1], "truncated")
    expect(path, raw[:60], "its 60 bytes end inside the header")
    first = good_bytes(1)
    expect(path, first[:10] + struct.pack("<d", 0.0) + first[18:], "time scale 0")


@pytest.mark.parametrize("format_id", [1, 2, 3, 4])
def test_truncation_at_any_byte_is_a_sentence(tmp_path, format_id):
    raw = good_bytes(format_id)
    path = tmp_path / "cut.outb"
    for size in range(len(raw)):
        path.write_bytes(raw[:size])
        with pytest.raises(DfsmError):
            read_openfast(path)


@quick
@given(st.binary(max_size=300), st.sampled_from([".outb", ".out"]))
@example(b"\x04\x00", ".out")
@example(b"\x02\x00" + b"\xff" * 100, ".outb")
@example(b"Time\n", ".out")
def test_random_bytes_are_a_sentence(tmp_path, raw, suffix):
    path = tmp_path / f"foreign{suffix}"
    path.write_bytes(raw)
    with pytest.raises(DfsmError):
        read_openfast(path)


@quick
@given(st.data())
def test_a_changed_header_byte_never_escapes(tmp_path, data):
    raw = bytearray(good_bytes(data.draw(st.sampled_from([1, 2, 3, 4]))))
    raw[data.draw(st.integers(0, 60))] = data.draw(st.integers(0, 255))
    path = tmp_path / "changed.outb"
    path.write_bytes(raw)
    try:
        run = read_openfast(path)
    except DfsmError:
        return
    # A smaller count leaves bytes over, which is told.
    assert len(run) == 4 or "bytes follow" in run.notes[0]


def test_bytes_left_over_are_told(tmp_path):
    path = tmp_path / "long.outb"
    path.write_bytes(good_bytes(4) + b"\0" * 7)
    run = read_openfast(path)
    np.testing.assert_array_equal(run.values, read_openfast(write_good(tmp_path)).values)
    (told,) = run.notes
    assert told.startswith("7 bytes follow the 4 samples that the header announces")


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    path = write_outb(tmp_path / "a.outb", *smooth_run(), NAMES, UNITS)
    monkeypatch.setitem(sys.modules, "openfast_io", None)
    with pytest.raises(DfsmError, match=r"pip install 'dfsm\[openfast\]'"):
        read_openfast(path)


def test_a_failure_inside_the_library_is_a_sentence(tmp_path, monkeypatch):
    from openfast_io import FAST_output_reader

    def broken(_path):
        raise struct.error("unpack requires a buffer of 8 bytes")

    path = write_outb(tmp_path / "a.outb", *smooth_run(), NAMES, UNITS)
    monkeypatch.setattr(FAST_output_reader, "load_binary_output", broken)
    with pytest.raises(DfsmError, match="could not be decoded"):
        read_openfast(path)


# -- text ---------------------------------------------------------------------------------------

TITLE = [
    "",
    "Predictions were generated on a day using OpenFAST",
    "linked with modules",
    "",
    "Description",
    "",
]
BODY = ["Time GenTq PtfmPitch", "(s) (kN-m) (deg)", "0.0 1.5 2E+1", "0.1 NaN -3.5", "0.2 7 8"]


def text_file(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("title", [[], TITLE, ["Time of writing: today", *TITLE, "", ""]])
def test_text_with_headers_of_any_length(tmp_path, title):
    run = read_openfast(text_file(tmp_path / "a.out", [*title, *BODY]))
    assert run.names == ("GenTq", "PtfmPitch")
    assert [c.unit for c in run.channels] == ["kN-m", "deg"]
    assert [c.step for c in run.channels] == [None, None]
    assert np.array_equal(run.time, [0, 0.1, 0.2])
    assert np.array_equal(run["GenTq"], [1.5, np.nan, 7], equal_nan=True)
    assert np.array_equal(run["PtfmPitch"], [20, -3.5, 8])


def test_text_without_units(tmp_path):
    run = read_openfast(text_file(tmp_path / "a.out", [BODY[0], *BODY[2:]]))
    assert [c.unit for c in run.channels] == ["", ""]
    assert len(run) == 3


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("0.3 1", "line 12: 2 values, but the header names 3 channels"),
        ("0.3 1 2 3", "line 12: 4 values"),
        ("**** 1 2", "line 12: the time is written as stars"),
        ("0.3 1 1.2x101", "line 12: '1.2x101' in column 3 is no number"),
        ("0.2 1 2", "time repeats at sample 3"),
        ("0.1 1 2", "time goes back at sample 3"),
        ("nan 1 2", "time is not a finite number in sample 3"),
    ],
)
def test_bad_rows_name_file_and_line(tmp_path, line, match):
    path = text_file(tmp_path / "a.out", [*TITLE, *BODY, line, "0.4 1 2"])
    with pytest.raises(DfsmError, match=match) as caught:
        read_openfast(path)
    assert str(path) in str(caught.value)


def test_every_row_ragged_alike(tmp_path):
    path = text_file(tmp_path / "a.out", [*BODY[:2], "0 1", "1 2"])
    with pytest.raises(DfsmError, match="line 3: 2 values, but the header names 3"):
        read_openfast(path)


def test_foreign_text(tmp_path):
    with pytest.raises(DfsmError, match="no line that starts with 'Time'"):
        read_openfast(text_file(tmp_path / "a.out", ["hello", "world"]))
    with pytest.raises(DfsmError, match="line 2: 2 units for the 3 names in line 1"):
        read_openfast(text_file(tmp_path / "b.out", ["Time a b", "(s) (m)", "0 1 2"]))
    with pytest.raises(DfsmError, match="no samples after its header, which ends in line 2"):
        read_openfast(text_file(tmp_path / "c.out", BODY[:2]))
    path = tmp_path / "d.out"
    path.write_bytes(b"Time a\n(s) (m)\n0 1\n1 \xff\n")
    with pytest.raises(DfsmError, match=r"neither text nor binary|is no number"):
        read_openfast(path)


# -- choosing files -----------------------------------------------------------------------------


def test_read_all_expands_and_reads_each_file_once(tmp_path):
    time, values = smooth_run()
    for name in ("b", "a", "c[1]"):
        write_outb(tmp_path / f"{name}.outb", time, values, NAMES, UNITS)
    runs = read_all(["*.outb", "a.outb", tmp_path / "b.outb"], base=tmp_path)
    assert [r.name for r in runs] == ["a", "b", "c[1]"]
    assert [r.name for r in read_all("c[1].outb", base=tmp_path)] == ["c[1]"]
    assert [r.name for r in read_all([str(tmp_path / "[ab].outb")])] == ["a", "b"]
    assert read_all([]) == []


def test_what_cannot_be_found_is_named(tmp_path):
    write_outb(tmp_path / "run_01.outb", *smooth_run(), NAMES, UNITS)
    with pytest.raises(DfsmError, match=r"no file matches 'runs/\*\.outb'"):
        read_all(["runs/*.outb"], base=tmp_path)
    with pytest.raises(DfsmError, match=r"no such file; .*did you mean 'run_01.outb'"):
        read_all(["run_1.outb"], base=tmp_path)
    with pytest.raises(DfsmError, match=r"its folder .* does not exist"):
        read(tmp_path / "nowhere" / "a.outb")
    with pytest.raises(DfsmError, match="is a folder"):
        read(tmp_path)
    (tmp_path / "a.xlsx").write_bytes(b"PK\x03\x04 something")
    with pytest.raises(DfsmError, match=r"'\.xlsx' is no known kind of file"):
        read(tmp_path / "a.xlsx")


def test_binary_content_is_known_under_any_name(tmp_path):
    path = write_outb(tmp_path / "result.dat", *smooth_run(), NAMES, UNITS)
    assert read(path).names == NAMES


# -- the relative wind --------------------------------------------------------------------------


def band_coherence(a, b, rate=20.0):
    from scipy.signal import coherence

    frequency, value = coherence(a, b, fs=rate, nperseg=2048)
    return value[(frequency >= 0.09) & (frequency <= 0.2)].mean()


def test_the_corrected_wind_holds_less_of_the_response():
    found = []
    for speed in ("06", "12", "18"):
        run = read(EXAMPLES / f"iea15_2dof_{speed}mps_s09.outb").window(100)
        run = undisturbed_rotor_wind(run, 150.0)
        wind = ("RtVAvgxh", "RtVAvgxhCorr", "RotWind")
        found.append([band_coherence(run[n], run["PtfmRVyt"]) for n in wind])
        distance = {n: np.std(run[n] - run["RotWind"]) for n in wind[:2]}
        assert distance["RtVAvgxhCorr"] < distance["RtVAvgxh"]
    # measured: 0.73, 0.64, 0.60 as it is; 0.17, 0.14, 0.21 corrected; 0.13, 0.15, 0.16 for RotWind
    relative, corrected, undisturbed = np.mean(found, axis=0)
    assert 0.6 < relative < 0.75
    assert corrected < 0.22
    assert undisturbed < 0.18
    assert (np.array(found)[:, 1] < 0.4 * np.array(found)[:, 0]).all()


def test_the_correction_converts_units_and_carries_the_step(tmp_path):
    time, values = smooth_run()
    path = tmp_path / "a.outb"
    names = ("RtVAvgxh", "PtfmRVyt", "X")
    run = read(write_outb(path, time, values, names, ("m/s", "deg/s", "m")))
    new = undisturbed_rotor_wind(run, 100.0)
    expected = run["RtVAvgxh"] + 100 * np.deg2rad(run["PtfmRVyt"])
    np.testing.assert_allclose(new["RtVAvgxhCorr"], expected, rtol=1e-15)
    steps = [run.channel(n).step for n in names[:2]]
    assert new.channel("RtVAvgxhCorr").step == pytest.approx(
        np.hypot(steps[0], 100 * np.deg2rad(steps[1]))
    )
    assert new.channel("RtVAvgxhCorr").unit == "m/s"
    run = read(write_outb(path, time, values, names, ("m/s", "rad/s", "m"), format_id=3))
    new = undisturbed_rotor_wind(run, 100.0, name="W")
    np.testing.assert_allclose(new["W"], values[:, 0] + 100 * values[:, 1], rtol=1e-15)
    assert new.channel("W").step is None
    with pytest.raises(DfsmError, match="'PtfmRVyt' is in 'm', expected deg/s or rad/s"):
        undisturbed_rotor_wind(
            read(write_outb(path, time, values, names, ("m/s", "m", "m"))), 100.0
        )
    with pytest.raises(DfsmError, match="'RtVAvgxh' is in 'kN', expected m/s"):
        undisturbed_rotor_wind(
            read(write_outb(path, time, values, names, ("kN", "deg/s", "m"))), 100.0
        )
    with pytest.raises(DfsmError, match="hub_height is -1"):
        undisturbed_rotor_wind(run, -1)
    with pytest.raises(DfsmError, match="'X' exists already"):
        undisturbed_rotor_wind(run, 100.0, name="X")
    with pytest.raises(DfsmError, match="no channel 'RotVel'"):
        undisturbed_rotor_wind(run, 100.0, wind="RotVel")


def test_wind_warning_names_relative_channels_only():
    warning = wind_warning("RtVAvgxh")
    assert warning is not None
    assert "platform's own motion" in warning
    assert "RotWind" in warning
    assert "RtVAvgxhCorr" in warning
    assert wind_warning("AB1N001VRel") is not None
    for name in ("RotWind", "RtVAvgxhCorr", "Wind1VelX", "Wave1Elev"):
        assert wind_warning(name) is None
