from __future__ import annotations

import re
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dfsm
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.readers.rotor_table import RotorTable
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms import (
    RotorTerm,
    Term,
)
from rotors import CHANNELS, COLUMNS, IEA15, RADIUS, TABLE, UNITS, rotor, term_of


@pytest.fixture(scope="module")
def plain() -> RotorTerm:
    return rotor().term(CHANNELS, COLUMNS)


@pytest.fixture(scope="module")
def moving() -> RotorTerm:
    settings = rotor(
        hub_height=150.0, pitch_rate="PitchRate", surge_rate="Surge", corrections=("Inner", "Outer")
    )
    return settings.term(CHANNELS, COLUMNS, {"Wind": 3.0, "Inner": 1.5, "Outer": 0.0})


def evaluate(term: Term, wind, speed, pitch) -> Array:
    """Values of a rotor at many winds in m/s, speeds in rpm and pitch angles in deg."""
    signals = np.stack(np.broadcast_arrays(wind, speed, pitch), axis=-1).reshape(-1, 3)
    return np.asarray(_values(term, signals.astype(float)))


# Once for all terms of one form: most calls ask for a single point.
@eqx.filter_jit
def _values(term: Term, signals: Array) -> jax.Array:
    return jax.vmap(term.values)(signals)


def speed_at(ratio, wind):
    return ratio * wind / RADIUS * 30 / np.pi


# -- the rotor inside its table -----------------------------------------------------------------


def test_values_at_the_nodes_are_those_of_the_table(plain):
    wind = 9.0
    ratio, pitch = np.meshgrid(TABLE.tip_speed_ratio, TABLE.pitch, indexing="ij")
    values = evaluate(plain, wind, speed_at(ratio, wind), pitch).reshape(*ratio.shape, 2)
    force = 0.5 * 1.225 * np.pi * RADIUS**2 * wind**2 / 1e3
    takes = TABLE.cp > 0
    for value, table in ((values[..., 0], TABLE.ct), (values[..., 1] / RADIUS, TABLE.cq)):
        # 1e-3 of the largest coefficient at which the rotor takes power.
        np.testing.assert_allclose(value / force, table, atol=1e-3 * np.abs(table[takes]).max())


def bilinear(table: Array, ratio: float, pitch: float) -> float:
    i = int(np.searchsorted(TABLE.tip_speed_ratio, ratio)) - 1
    j = int(np.searchsorted(TABLE.pitch, pitch)) - 1
    a = (ratio - TABLE.tip_speed_ratio[i]) / np.diff(TABLE.tip_speed_ratio)[i]
    b = (pitch - TABLE.pitch[j]) / np.diff(TABLE.pitch)[j]
    return float(np.array([1 - a, a]) @ table[i : i + 2, j : j + 2] @ np.array([1 - b, b]))


@pytest.mark.parametrize(
    ("wind", "rpm", "pitch"),
    [(8.0, 5.6, 0.3), (10.6, 7.56, 0.1), (12.2, 7.5, 7.4), (18, 7.6, 14.6)],
)
def test_operating_points_agree_with_bilinear_interpolation(plain, wind, rpm, pitch):
    ratio = rpm * np.pi / 30 * RADIUS / wind
    thrust = 0.5 * 1.225 * np.pi * RADIUS**2 * wind**2 * bilinear(TABLE.ct, ratio, pitch)
    torque = 0.5 * 1.225 * np.pi * RADIUS**3 * wind**2 * bilinear(TABLE.cq, ratio, pitch)
    inputs = jnp.zeros(len(UNITS)).at[np.array(plain.columns)].set(jnp.array([wind, rpm, pitch]))
    np.testing.assert_allclose(plain(inputs), [thrust / 1e3, torque / 1e3], rtol=1e-2)


def test_rated_power_of_the_turbine(plain):
    _, torque = evaluate(plain, 10.6, 7.56, 0.0)[0]
    # 15 MW electric at 96 % from about 15.6 MW of the rotor.
    assert 14_500 < torque * 7.56 * np.pi / 30 < 17_000


def test_units_of_speed_and_pitch_and_a_gearbox_change_nothing(plain):
    geared = rotor(speed="Generator", pitch="Radians", gearbox_ratio=97.0)
    alike = geared.term(CHANNELS, COLUMNS)
    signals = jnp.array([11.0, 7.0 * 6 * 97, np.deg2rad(4.0)])
    np.testing.assert_allclose(alike.values(signals), evaluate(plain, 11, 7, 4)[0], rtol=1e-12)
    direct = term_of(rotor(speed="RadPerSecond"))
    radians = jnp.array([11.0, 7.0 * np.pi / 30, 4.0])
    np.testing.assert_allclose(direct.values(radians), evaluate(plain, 11, 7, 4)[0], rtol=1e-12)


def test_motion_and_corrections_change_the_wind(moving, plain):
    assert moving.channels == (Channel("rotor.thrust", "kN"), Channel("rotor.torque", "kN-m"))
    signals = jnp.array([11.0, 7.0, 4.0, 0.3, 0.5, 0.8, -0.6])
    wind = 11.0 - 150.0 * np.deg2rad(0.3) - 0.5
    np.testing.assert_allclose(
        moving.values(signals), evaluate(plain, wind, 7, 4)[0], rtol=1e-12, atol=0
    )
    moved = moving.moved([jnp.array([0.25, -0.5])])
    # One unit of a weight's deviation is what makes a correction as large as the wind.
    np.testing.assert_array_equal(moved.parameters[0], [0.25 * 2.0, -0.5])
    wind += 0.5 * 0.8 + 0.5 * 0.6
    np.testing.assert_allclose(
        moved.values(signals), evaluate(plain, wind, 7, 4)[0], rtol=1e-12, atol=0
    )


def test_derivative_with_respect_to_the_weights(moving):
    signals = jnp.array([11.0, 7.0, 4.0, 0.3, 0.5, 0.8, -0.6])

    @jax.jit
    def values(deviation: jax.Array) -> jax.Array:
        return moving.moved([deviation]).values(signals)

    at, step = np.array([0.1, 0.2]), 1e-5
    numeric = [(values(at + step * e) - values(at - step * e)) / (2 * step) for e in np.eye(2)]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(values))(at), np.stack(numeric, 1), rtol=1e-6)


def test_density_and_name():
    water = term_of(rotor(density=1025.0, name="upstream"))
    air = term_of(rotor(density=1.0))
    assert [c.name for c in water.channels] == ["upstream.thrust", "upstream.torque"]
    signals = jnp.array([9.0, 7.0, 1.0])
    np.testing.assert_allclose(water.values(signals), 1025 * air.values(signals), rtol=1e-12)


def test_uneven_axes_and_a_table_from_no_rotation_on():
    pitch = np.array([-3.0, -1.0, 0.0, 0.5, 1.0, 2.0, 5.0, 9.0, 15.0, 25.0])
    ratio = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 6.0, 7.0, 7.5, 8.0, 9.0, 12.0, 18.0])
    b, x = np.meshgrid(pitch, ratio)
    cq = 0.06 * np.exp(-(((x - 6) / 4) ** 2) - (b / 10) ** 2) - 0.0004 * x
    table = RotorTable(pitch, ratio, cq * x, 0.02 + 0.09 * x * np.exp(-0.02 * b), cq)
    term = term_of(rotor(table=table))
    wind, takes = 9.0, table.cp > 0
    values = evaluate(term, wind, speed_at(x, wind), b).reshape(*x.shape, 2)
    force = 0.5 * 1.225 * np.pi * RADIUS**2 * wind**2 / 1e3
    assert term.about.error < 1e-3
    thrust = np.abs(values[..., 0] / force - table.ct).max() / table.ct[takes].max()
    torque = np.abs(values[..., 1] / force / RADIUS - cq).max() / cq[takes].max()
    # Where the rotor stands, a tip speed of 0.01 m/s is counted instead.
    assert max(thrust, torque) < 2e-3


# -- the rotor beyond its table -----------------------------------------------------------------

EVERYWHERE = np.array(
    [
        (wind, speed, pitch)
        for wind in (-70.0, -12.0, -2.0, -0.05, 0.0, 0.05, 1.0, 4.0, 9.0, 20.0, 70.0)
        for speed in (-1.0, 0.0, 0.02, 1.0, 5.0, 9.0, 25.0)
        for pitch in (-90.0, -11.0, -5.2, 0.3, 12.4, 30.4, 34.0, 90.0)
    ]
)


def test_values_and_derivatives_are_finite_everywhere(plain):
    at = jnp.asarray(EVERYWHERE)
    for function in (plain.values, jax.jacfwd(plain.values), jax.jacrev(plain.values)):
        assert np.isfinite(np.asarray(jax.jit(jax.vmap(function))(at))).all()
    second = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(plain.values))))(at)
    assert np.isfinite(np.asarray(second)).all()


def test_derivatives_agree_with_differences_everywhere(plain):
    moves = EVERYWHERE[(np.abs(EVERYWHERE[:, :2]) > 0.03).any(axis=1)]
    slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(plain.values)))(jnp.asarray(moves)))
    values = jax.jit(jax.vmap(plain.values))
    for k, step in enumerate((1e-5, 1e-5, 1e-4)):
        shift = step * np.eye(3)[k]
        numeric = np.asarray(values(moves + shift) - values(moves - shift)) / (2 * step)
        scale = np.abs(np.asarray(values(moves))) + np.array([1.0, 100.0])
        assert (np.abs(slopes[..., k] - numeric) < 1e-5 * np.abs(numeric) + 1e-5 * scale).all()


@eqx.filter_jit
def _slopes(term: RotorTerm, a: Array, b: Array, at: Array) -> jax.Array:
    """First and second derivatives along a line, ``(place, 2, value)``."""

    def along(t: jax.Array) -> jax.Array:
        return term.values(a + t * (b - a))

    slope = jax.jacfwd(along)
    return jax.vmap(lambda t: jnp.stack([slope(t), jax.jacfwd(slope)(t)]))(at)


@pytest.mark.parametrize(
    ("start", "stop"),
    [
        ((-9.0, 7.0, 2.0), (30.0, 7.0, 2.0)),  # from behind, through no wind, the table and beyond
        ((9.0, 0.1, -3.5), (9.0, 14.0, -3.5)),
        ((11.0, 7.0, -16.0), (11.0, 7.0, 45.0)),
        ((4.0, 9.0, 31.0), (15.0, 5.0, -6.0)),
    ],
)
def test_first_and_second_derivatives_have_no_steps(plain, start, stop):
    widest = []
    for count in (2000, 4000):
        at = np.linspace(0, 1, count + 1)
        values = np.asarray(_slopes(plain, np.array(start), np.array(stop), at))
        widest.append(np.abs(np.diff(values, axis=0)).max(axis=0))
    # Steps of a continuous function shrink with the distance; a jump would stay.
    assert (widest[1] < 0.65 * widest[0]).all()


def test_forces_die_away_with_all_motion_and_grow_no_faster_than_its_square(plain):
    assert (np.abs(evaluate(plain, 0.0, 0.0, 3.0)) < 1e-3).all()
    near = evaluate(plain, -40.0, 10.0, 3.0)
    np.testing.assert_allclose(evaluate(plain, -400.0, 100.0, 3.0), 100 * near, rtol=1e-6)


def test_no_table_gives_power_without_wind():
    pitch, ratio = np.linspace(-5, 25, 7), np.linspace(2, 14, 13)
    b, x = np.meshgrid(pitch, ratio)
    # A torque that rises with the speed of the rotor: continued as it is, it would drive itself.
    cq = 0.06 * np.exp(-(((x - 6) / 3) ** 2) - (b / 10) ** 2) + 1e-5 * x**2
    term = term_of(rotor(table=RotorTable(pitch, ratio, cq * x, 0.09 * x - 0.005 * b, cq)))
    assert evaluate(term, 6.0, speed_at(13.5, 6.0), 10.0)[0, 1] > 0
    still = evaluate(term, 0.0, np.array([1.0, 7.0, 12.0]), 10.0)
    largest = evaluate(term, 6.0, speed_at(6.0, 6.0), 0.0)[0, 1]
    assert (still[:, 1] < 1e-3 * largest).all()


@pytest.mark.parametrize("pitch", [-40.0, -5.0, 0.0, 4.0, 12.0, 25.0, 30.0, 60.0])
def test_signs_beyond_the_table(plain, pitch):
    standing = evaluate(plain, np.array([40.0, 400.0, -40.0, -400.0]), 0.0, pitch)[:, 0]
    # Drag follows the wind, and with it grows like v|v|.
    assert (standing[:2] > 0).all()
    assert (standing[2:] < 0).all()
    np.testing.assert_allclose(standing[1::2] / standing[::2], 100, rtol=1e-2)
    # A hard wind from behind pushes the rotor back, and no rotor takes power without wind.
    assert evaluate(plain, -80.0, 5.0, pitch)[0, 0] < 0
    turning = evaluate(plain, np.linspace(-30, 0, 31), 7.0, pitch)
    assert (turning[:, 1] < 0).all()


def test_thrust_rises_with_the_wind_down_to_none(plain):
    wind = np.linspace(-25.0, 12.0, 400)
    for pitch in (-5.0, 0.0, 5.0, 15.0):
        assert (np.diff(evaluate(plain, wind, 7.5, pitch)[:, 0]) > 0).all()


def test_pitch_beyond_the_table_levels_off(plain):
    far = evaluate(plain, 11.0, 7.0, np.array([38.0, 45.0, 1000.0]))
    np.testing.assert_array_equal(far[0], far[1])
    np.testing.assert_array_equal(far[0], far[2])
    near = evaluate(plain, 11.0, 7.0, np.array([30.0, 30.5, 31.0]))
    slope = (evaluate(plain, 11.0, 7.0, 30.0) - evaluate(plain, 11.0, 7.0, 29.9)) / 0.1
    assert (np.sign(near[1] - near[0]) == np.sign(slope[0])).all()


def test_samples_beyond_the_table_are_told(moving, plain):
    inputs = np.zeros((6, len(UNITS)))
    inputs[:, [COLUMNS[n] for n in ("Wind", "Speed", "Pitch")]] = [
        (11, 7, 4),
        (-1, 7, 4),
        (0, 0, 4),
        (40, 5, 4),
        (4, 7, 4),
        (11, 7, 31),
    ]
    assert plain.beyond(inputs).tolist() == [False, True, True, True, True, True]
    # Swinging down the wind at 6 deg/s leaves none of it.
    inputs[0, COLUMNS["PitchRate"]] = 6.0
    assert moving.beyond(inputs[0])
    assert plain.beyond(inputs[None]).shape == (1, 6)


# -- what the fit asks of a rotor ---------------------------------------------------------------


def test_acceleration_per_torque():
    inertia = 3.2e8
    term = term_of(rotor(inertia=inertia, generator_torque="Torque"))
    # J ω' = T, in rpm/s per kN m.
    expected = 1e3 / inertia * 30 / np.pi
    assert term.acceleration_per_rotor_torque == pytest.approx(expected, rel=1e-12)
    assert term.acceleration_per_generator_torque == pytest.approx(-expected, rel=1e-12)
    drive = {"speed": "Generator", "gearbox_ratio": 50.0, "efficiency": 0.95}
    geared = term_of(rotor(inertia=inertia, generator_torque="Torque", **drive))
    shaft = 1e3 / inertia * 50 * 180 / np.pi
    assert geared.acceleration_per_rotor_torque == pytest.approx(shaft, rel=1e-12)
    generator = -shaft * 50 / 0.95
    assert geared.acceleration_per_generator_torque == pytest.approx(generator, rel=1e-12)
    assert term_of(rotor()).acceleration_per_rotor_torque is None
    assert term_of(rotor()).acceleration_per_generator_torque is None


@pytest.fixture(scope="module")
def records() -> dict[int, dict[str, Array]]:
    runs = {
        wind: dfsm.read(IEA15 / f"iea15_2dof_{wind:02d}mps_s02.parquet").window(100)
        for wind in (6, 12, 18)
    }
    names = {"Wind": "RotWind", "Speed": "GenSpeed", "Pitch": "BldPitch1"}
    return {w: {n: r[name] for n, name in names.items()} for w, r in runs.items()}


def test_records_of_the_rotor_are_not_doubted(plain, records):
    for values in records.values():
        assert plain.check(values) == []
    together = {n: np.concatenate([r[n] for r in records.values()]) for n in records[6]}
    assert plain.check(together) == []


def test_a_speed_in_another_unit_is_refused(plain, records):
    values = records[12] | {"Speed": records[12]["Speed"] * np.pi / 30}
    message = (
        r"100 % of the tip speed ratios .*\(2 to 14.5\), their median is 0\.\d+; were 'Speed' "
    )
    with pytest.raises(DfsmError, match=message + "in rad/s, it would lie within it"):
        plain.check(values)
    fast = term_of(rotor(gearbox_ratio=1.0))
    with pytest.raises(DfsmError, match="the gearbox ratio 1 and that the table is this rotor's"):
        fast.check(records[12] | {"Speed": 100 * records[12]["Speed"]})


def test_pitch_in_radians_is_refused(plain, records):
    together = {n: np.concatenate([r[n] for r in records.values()]) for n in records[6]}
    for values in (records[18], together):
        radians = values | {"Pitch": np.deg2rad(values["Pitch"])}
        with pytest.raises(DfsmError, match=r"'Pitch' says deg .* only as rad does it shed"):
            plain.check(radians)


def test_pitch_in_degrees_that_says_radians_is_refused(records):
    term = term_of(rotor(pitch="Radians"))
    with pytest.raises(DfsmError, match="check that 'Radians' is in rad and is the blade pitch"):
        term.check(records[18] | {"Radians": records[18]["Pitch"]})


def test_small_pitch_that_controls_nothing_is_not_refused(plain, records):
    values = records[18]
    for pitch in (
        np.full_like(values["Pitch"], 1.2),
        0.02 * np.sin(np.arange(len(values["Wind"]))),
    ):
        assert plain.check(values | {"Pitch": pitch}) == []


def test_samples_partly_beyond_the_table_are_told(plain, records):
    values = {n: v[:1000].copy() for n, v in records[12].items()}
    values["Wind"][:200] = -1.0
    (doubt,) = plain.check(values)
    assert doubt.startswith("rotor.thrust: 20 % of the tip speed ratios lie beyond its table")
    values = {n: v[:1000].copy() for n, v in records[12].items()}
    values["Pitch"][:300] = 40.0
    (doubt,) = plain.check(values)
    assert "which leaves 30 % of the samples out" in doubt


def test_coarse_tables_are_told(plain, records):
    coarse = replace(plain, about=replace(plain.about, error=0.02))
    (doubt,) = coarse.check(records[12])
    assert "differ from its table by up to 2 %" in doubt


def test_factors_of_an_uncertain_table(plain):
    uncertain = rotor(uncertainty=0.1).term(CHANNELS, COLUMNS)
    rng = np.random.default_rng(4)
    signals = rng.uniform([-5, 0, -20], [30, 9, 60], (40, 3))
    exact = np.asarray(_values(plain, signals))
    np.testing.assert_array_equal(_values(uncertain, signals), exact)
    assert [a.shape for a in uncertain.parameters] == [(2, 6)]
    # A deviation of 1 is a change by the share that is uncertain.
    constant = uncertain.moved([from_host(np.eye(2, 6) * np.array([[1.0], [0.0]]))])
    np.testing.assert_allclose(_values(constant, signals), exact * np.array([1.1, 1.0]), rtol=1e-12)
    # Bounded whatever the inflow.
    moved = uncertain.moved([from_host(rng.standard_normal((2, 6)))])
    most = 1 + np.abs(moved.trim).sum(axis=1)
    found = np.asarray(_values(moved, signals))
    assert np.all(np.abs(found) <= np.abs(exact) * most * (1 + 1e-12))
    assert np.abs(found - exact).max() > 1.0
    again = RotorTerm.restored(moved.columns, moved.channels, moved.arrays(), moved.structure())
    np.testing.assert_array_equal(_values(again, signals), found)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius": 0.0}, "rotor.radius is 0.0, expected a positive number of m"),
        ({"radius": float("nan")}, "rotor.radius is nan"),
        ({"hub_height": -1.0, "pitch_rate": "PitchRate"}, "rotor.hub_height is -1.0"),
        ({"gearbox_ratio": 0.0}, "rotor.gearbox_ratio is 0.0"),
        ({"inertia": -5.0}, "rotor.inertia is -5.0"),
        ({"inertia": 3e8}, "without rotor.generator_torque"),
        ({"generator_torque": "Torque"}, "without rotor.inertia"),
        ({"efficiency": 1.2}, "rotor.efficiency is 1.2"),
        ({"efficiency": 0.0}, "rotor.efficiency is 0.0"),
        ({"density": 12.25}, "rotor.density is 12.25, expected kg/m³ of air (0.8 to 1.6) or water"),
        ({"uncertainty": -0.1}, "rotor.uncertainty is -0.1, expected a share from 0 to 1"),
        ({"name": ""}, "rotor.name is empty"),
        ({"hub_height": 150.0}, "rotor.hub_height is 150.0 without rotor.pitch_rate"),
        ({"pitch_rate": "PitchRate"}, "rotor.pitch_rate is PitchRate without rotor.hub_height"),
        ({"corrections": ("Inner", "Inner")}, "channel 'Inner' is named twice"),
        ({"wind": "Speed", "speed": "RadPerSecond"}, "its wind 'Speed' is in 'rpm', expected m/s"),
        ({"speed": "Surge"}, "its speed 'Surge' is in 'm/s', expected rpm or rad/s or deg/s"),
        ({"pitch": "PitchRate"}, "its pitch 'PitchRate' is in 'deg/s', expected rad or deg"),
        (
            {"hub_height": 150.0, "pitch_rate": "Surge"},
            "its pitch_rate 'Surge' is in 'm/s', expected rad/s or deg/s",
        ),
        ({"surge_rate": "PitchRate"}, "its surge_rate 'PitchRate' is in 'deg/s', expected m/s"),
        ({"corrections": ("Torque",)}, "its corrections 'Torque' is in 'kN-m', expected m/s"),
        ({"wind": "Wnd"}, "'Wnd' is no state, control, disturbance or parameter of the model; did"),
        ({"table": "nothing.txt"}, "nothing.txt: no such file"),
    ],
)
def test_settings_of_a_rotor_that_are_refused(changes, message):
    with pytest.raises(DfsmError, match=re.escape(message)):
        term_of(rotor(**changes))


def test_missing_arrays_are_key_errors(plain):
    told = plain.structure()
    with pytest.raises(KeyError):
        RotorTerm.restored(plain.columns, plain.channels, {}, told)
    del told["about"]["radius"]
    with pytest.raises(KeyError):
        RotorTerm.restored(plain.columns, plain.channels, plain.arrays(), told)
