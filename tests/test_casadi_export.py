"""Functions of CasADi against the model that they were made of, and what cannot be exported."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dfsm
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.exports.casadi_model import to_function
from dfsm.exports.translate import UntranslatableError, translated
from dfsm.models.model_folder import save
from dfsm.models.signals import Azimuth
from dfsm.models.terms import Function, Terms
from exported import close, drive, friction, points, turning, whole
from systems import linear_model

PAGE = Path(__file__).parents[1] / "docs" / "exports.md"


@pytest.fixture(scope="module")
def functions():
    return dfsm.to_casadi(whole())


def test_a_model_of_all_parts_is_the_same_inside_and_outside_the_data(functions):
    model = whole()
    groups = points(model)
    columns = [group.T for group in groups]
    ours = functions.f.map(len(groups[0]))(*columns)
    close(np.array(ours).T, np.asarray(model.derivative(*groups)))
    ours = functions.g.map(len(groups[0]))(*columns)
    close(np.array(ours).T, np.asarray(model.output(*groups)))
    psi, field = turning(model)
    ours = functions.g_at_azimuth.map(len(psi))(*columns, psi[None], field.T)
    close(np.array(ours).T, np.asarray(model.output(*groups, azimuth=psi, field=field)))


def test_first_and_second_derivatives(functions):
    model, groups = whole(), [group[300:330] for group in points(whole())]
    arguments = [casadi.MX.sym(n, functions.f.size1_in(k)) for k, n in enumerate("xuwp")]
    driving = casadi.vertcat(*arguments[:2])
    value = functions.f(*arguments)
    slopes = casadi.jacobian(value, driving)
    bends = casadi.jacobian(casadi.jacobian(value[0], driving), driving)
    symbolic = casadi.Function("d", arguments, [slopes, bends])

    def f(v, w, p):
        return model.derivative(v[:5], v[5:], w, p)

    first = jax.jit(jax.vmap(jax.jacfwd(f)))
    v, w, p = np.concatenate(groups[:2], axis=1), *groups[2:]
    expected, moves = np.asarray(first(v, w, p)), 1e-5 * np.eye(7)
    ahead, behind = (
        np.stack([np.asarray(first(v + sign * d, w, p))[:, 0] for d in moves], axis=1)
        for sign in (1, -1)
    )
    for k in range(30):
        ours = symbolic(*(group[k] for group in groups))
        close(np.array(ours[0]), expected[k], 1e-9)
        close(np.array(ours[1]).ravel(), (ahead[k] - behind[k]).ravel() / 2e-5, 1e-5)
    # That the rate of the heave is its velocity is known, not computed.
    known = functions.f.jacobian().sparsity_out(0).row()
    assert known.count(1) == 1


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_a_rollout_of_600_s(functions):
    model, run = whole(), drive(whole())
    start = [8.0, 0.2, 0.0, 0.1, -0.1]
    simulated = dfsm.simulate(model, run, initial=start).trajectory
    x, u, h = casadi.MX.sym("x", 5), casadi.MX.sym("u", 2), run.time[1]
    w0, w1, p = casadi.MX.sym("w0", 2), casadi.MX.sym("w1", 2), casadi.MX.sym("p", 1)
    v0, v1 = u[1], casadi.MX.sym("v1")  # the torque is held, the pitch goes on along a line

    def f(x, share):
        controls = casadi.vertcat(u[0], (1 - share) * v0 + share * v1)
        return functions.f(x, controls, (1 - share) * w0 + share * w1, p)

    k1 = f(x, 0)
    k2 = f(x + h / 2 * k1, 0.5)
    k3 = f(x + h / 2 * k2, 0.5)
    k4 = f(x + h * k3, 1)
    arguments = [x, u, v1, w0, w1, p]
    step = casadi.Function("s", arguments, [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    controls = run.select(model.signals.names("controls")).values.T
    wind = run.select(model.signals.names("disturbances")).values.T
    mass = np.full((1, len(run) - 1), run["mass"][0])
    steps = (controls[:, :-1], controls[1:, 1:], wind[:, :-1], wind[:, 1:], mass)
    path = np.array(step.mapaccum(len(run) - 1)(start, *steps)).T
    names = model.signals.names("states")
    close(path, simulated.select(names).values[1:], 1e-9)


def test_what_the_functions_take_is_told(functions, tmp_path):
    functions.save(tmp_path / "model.casadi")
    file = casadi.FileDeserializer(str(tmp_path / "model.casadi"))
    f, g, told, turned = file.unpack(), file.unpack(), json.loads(file.unpack()), file.unpack()
    assert f.name_in() == ["states", "controls", "disturbances", "parameters"]
    assert (g.name_out(), turned.name_in()[4:]) == (["outputs"], ["azimuth", "field"])
    heave = {"name": "heave <z>", "unit": "m", "start": 0.0, "trained": [-2.0, 2.0]}
    assert told["states"][1] == heave
    assert [c["between_samples"] for c in told["controls"]] == ["hold", "linear"]
    assert told["computed_inputs"] == ["eta_dot (m/s) is the time derivative of eta: supply it"]
    # Latent states start where the inputs hold them: their row of f̂ is zero.
    start = [[c["start"] for c in told[name]] for name in f.name_in()]
    np.testing.assert_allclose(np.array(f(*start))[3:], 0, atol=1e-12)
    assert casadi.Function.load(str(tmp_path / "model.casadi")).name() == "f"


def test_blade_harmonics_without_rings_and_a_model_without_outputs():
    A, B = np.array([[-0.5]]), np.array([[1.0]])
    azimuth = Azimuth(speed="x0")
    model = linear_model(A, B, np.array([[2.0]]), azimuth=azimuth, units=["rpm"])
    functions = dfsm.to_casadi(model)
    value = functions.g_at_azimuth([3.0], [0.0], [], [], 0.4, [])
    expected = model.output([3.0], [0.0], [], [], 0.4)
    np.testing.assert_allclose(np.array(value).ravel(), np.asarray(expected), rtol=1e-14)
    bare = dfsm.to_casadi(linear_model(A, B))
    assert bare.g([1], [1], [], []).shape == (0, 1)
    assert bare.g_at_azimuth is None


def with_function(function):
    model = linear_model(np.array([[-1.0]]), np.array([[1.0]]))
    channels = {c.name: c for c in model.signals.inputs}
    term = Function(name="mine", function=function, inputs=("x0",))
    part = term.term(channels, {c: i for i, c in enumerate(channels)})
    L = jnp.concatenate([model.f.coefficients, jnp.ones((1, 1, 1))], axis=2)
    terms = Terms((part,), jnp.zeros(1), jnp.ones(1))
    return replace(model, f=replace(model.f, coefficients=L), terms=terms)


def test_what_has_no_counterpart_is_refused_by_name():
    def endless(x):
        return jax.lax.while_loop(lambda v: v > 1, lambda v: v / 2, x)

    def called(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), x)

    for function, primitive in ((endless, "while"), (called, "pure_callback")):
        with pytest.raises(DfsmError, match=f"'mine' cannot be exported.*'{primitive}'"):
            dfsm.to_casadi(with_function(function))


TABLE = jnp.arange(12.0).reshape(3, 4) ** 1.5


def _loop(x):
    def turn(k, carry):
        return carry * x[k % 3] + k

    y = jax.lax.fori_loop(0, 5, turn, x[0]) + jnp.polyval(jnp.array([1.0, 2.0, 3.0]), x[1])
    return y[None]


def _moved(x):
    y = jnp.pad(x[::-1], (1, 2), constant_values=7.0).at[1].set(x[2])
    return jnp.concatenate([y, jnp.outer(x, x)[jnp.tril_indices(3)], jnp.roll(x, 1)])


def _looked_up(x):
    at = jnp.floor(x).astype(int)
    many = jax.vmap(lambda k: TABLE[k % 3, jnp.clip(k, 0, 3)])(at)
    return jnp.concatenate(
        [many, jnp.take(TABLE, at[0], axis=0, fill_value=-1.0), x[at % 3], TABLE[:, at[1] % 4]]
    )


def _chosen(x):
    both = jax.lax.cond(x[0] > 0, lambda v: v**3, lambda v: 1 / (1 + v**2), x)
    cases = jax.lax.switch((x[1] > 0).astype(int) + (x[2] > 0), [jnp.sin, jnp.cos, jnp.exp], x)
    return both + cases + jnp.clip(x, -0.5, 0.5) * ((x > 0) & ~(x > 1)) + x // 0.7


def _elementary(x):
    a, b = jnp.abs(x) + 0.1, jnp.tanh(x)
    every = [jnp.exp2(x), jnp.cbrt(x), jax.nn.sigmoid(x), jax.lax.rsqrt(a), jnp.arctan2(x, a)]
    every += [jax.scipy.special.erf(x), jnp.arcsin(b), jnp.arccosh(1 + a), a**x, jnp.expm1(x)]
    every += [jnp.hypot(x, a), jax.nn.softplus(x), jnp.sign(x), jnp.mod(x, 0.3), x**-2, x**0]
    return jnp.stack(every).ravel()


def _complex(x):
    z = (x[0] + 1j * x[1]) * jnp.exp(1j * x[2]) / 2 - jnp.conj(x[1] + 2j)
    return jnp.stack([z.real, z.imag])


def _products(x):
    A = jnp.einsum("i,jk->ijk", x, TABLE)
    sums = [
        A.sum(axis=(0, 2)),
        A.max(axis=1).ravel(),
        A.min(axis=2).ravel(),
        jnp.prod(A, axis=0)[1],
    ]
    return jnp.concatenate([*sums, jnp.einsum("ijk,ilk->ijl", A, A).ravel(), (x @ TABLE) * x.any()])


def _running(x):
    A = jnp.outer(x, jnp.array([1.0, -2.0, 0.5]))
    both = [jnp.cumsum(A, axis=1), jnp.cumprod(A, axis=0), jax.lax.cummax(A, reverse=True)]
    places = jnp.stack([jnp.argmax(x), jnp.argmin(A[0])]) + jnp.argmax(A, axis=1)[:2]
    return jnp.concatenate([jnp.stack(both).ravel(), places, jnp.tile(x, 2)])


def _by_cases(x):
    cases = [jnp.select([x < -1, x < 1], [x, x**2], x**3)]
    cases += [jnp.piecewise(x, [x < 0, x > 1], [jnp.sin, jnp.cos, lambda v: v])]
    cases += [jnp.where((x > 0) ^ (x > 1), x, 0.0), jnp.where(jnp.isfinite(1 / x), x, 9.0)]
    return jnp.concatenate([*cases, jax.nn.logsumexp(x)[None], (3e9 * x).astype(jnp.int32)])


@pytest.mark.parametrize(
    "function",
    [_loop, _moved, _looked_up, _chosen, _elementary, _complex, _products, _running, _by_cases],
)
def test_a_users_function_means_what_jax_means(function):
    inputs = np.random.default_rng(4).normal(size=(40, 3)) * 1.7
    program = to_function(translated(function, [("x", 3)]), "g")
    ours = np.array(program.map(40)(inputs.T)).T
    close(ours, np.asarray(jax.jit(jax.vmap(function))(jnp.asarray(inputs))), 1e-12)


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (lambda x: (x.astype(int) & 6) * 1.0, "and of the bits of whole numbers"),
        (lambda x: ~x.astype(int) * 1.0, "not of the bits of whole numbers"),
        (lambda x: (x * 100).astype(jnp.uint8) * 1.0, "whole numbers that end at 255"),
    ],
)
def test_whole_numbers_of_bits_are_refused(function, named):
    # Truths and fractions in their place would be other numbers without a word.
    with pytest.raises(UntranslatableError, match=named):
        translated(function, [("x", 2)])


def test_a_table_that_is_looked_up_beyond_its_ends():
    places = np.linspace(-4, 4, 81)[:, None]
    program = translated(lambda x: friction(x[0], x[0])[None], [("x", 1)])
    ours = np.array(to_function(program, "g").map(81)(places.T)).T
    expected = [[float(friction(jnp.asarray(v), jnp.asarray(v)))] for v in places[:, 0]]
    close(ours, np.array(expected), 1e-12)


def test_the_command_line(tmp_path, monkeypatch, dfsm):
    monkeypatch.chdir(tmp_path)
    save(linear_model(np.array([[-1.0]]), np.array([[2.0]])), "model")
    shown = dfsm("export", "casadi", "model", "-o", "m.casadi")
    assert (shown.code, shown.err, shown.out) == (0, "", "wrote m.casadi\n")
    assert float(casadi.Function.load("m.casadi")([3], [4], [], [])) == 5.0
    shown = dfsm("export", "casadi", "model", "-o", "nowhere/m.casadi")
    assert (shown.code, shown.err.count("\n")) == (2, 1)


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile("\n".join(blocks), str(PAGE), "exec"), {})


def test_a_channel_is_no_surprise_in_a_description():
    # Units with letters beyond ASCII survive.
    model = linear_model(np.array([[-1.0]]), np.array([[2.0]]), names=["θ"], units=["°/s"])
    assert dfsm.to_casadi(model).description["states"][0]["unit"] == Channel("θ", "°/s").unit
