"""Evaluate and simulate the model that was exported beside this file; it needs NumPy alone.

    from run_model import Model

    model = Model("model.npz")
    model.derivative(states, controls, disturbances, parameters)    # per second
    model.output(states, controls, disturbances, parameters)
    states, outputs = model.simulate(time, initial, controls, disturbances, parameters)

Names, units and start values of all vectors, in order, stand in `model.description`.
`python run_model.py` prints them. Made by dfsm; the numbers are in model.npz, nothing is executed.
"""

import json
import math
import sys

import numpy as np

GROUPS = ("states", "controls", "disturbances", "parameters")
UNARY = {
    **{n: getattr(np, n) for n in ("sign", "floor", "ceil", "sqrt", "exp", "log", "log1p")},
    **{n: getattr(np, n) for n in ("expm1", "sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "neg": np.negative,
    "abs": np.abs,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "erf": np.vectorize(math.erf, otypes=[float]),
    "not": np.logical_not,
}
BINARY = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "pow": np.power,
    "atan2": np.arctan2,
    "max": np.maximum,
    "min": np.minimum,
    "rem": np.fmod,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
}
REDUCE = {"sum": np.sum, "max": np.max, "min": np.min, "prod": np.prod}


class Program:
    """A list of steps, each of which makes a flat array of earlier ones."""

    def __init__(self, name, steps, arrays):
        self.count, self.result = steps["inputs"], steps["result"]
        self.constants = [arrays[f"{name}.c{k}"] for k in range(steps["constants"])]
        self.steps = [
            self.prepared(arrays.get(f"{name}.p{k}"), *step)
            for k, step in enumerate(steps["steps"])
        ]

    @staticmethod
    def prepared(places, kind, of, what, shape):
        """The function of one step, and the numbers of what it takes."""
        if kind == "apply":
            # Truth is a number here.
            ufunc = (UNARY if len(of) == 1 else BINARY)[what]
            return (lambda *v: ufunc(*v) * 1.0), of
        if kind == "select":
            return (lambda c, a, b: np.where(c != 0, a, b)), of
        if kind == "take":
            return (lambda v: v[places]), of
        if kind == "lookup":
            return (lambda v, at: v[np.nan_to_num(at).astype(int)]), of
        if kind == "join":
            return (lambda *v: np.concatenate(v)), of
        if kind == "matmul":
            m, n, p = shape
            return (lambda a, b: (a.reshape(m, n) @ b.reshape(n, p)).ravel()), of
        return (lambda a: REDUCE[what](a.reshape(shape), axis=1)), of

    def __call__(self, *inputs):
        """The result for flat input arrays."""
        values = [*inputs, *self.constants]
        for function, of in self.steps:
            values.append(function(*(values[k] for k in of)))
        return values[self.result]


class Model:
    """f and g of the model in `path`; vectors are in the order and units of `description`."""

    def __init__(self, path="model.npz"):
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        told = json.loads(arrays.pop("description").tobytes().decode())
        self.description = told["description"]
        self.programs = {n: Program(n, steps, arrays) for n, steps in told["programs"].items()}

    def names(self, group):
        """Names of a group: states, controls, disturbances, parameters, outputs or field."""
        return [entry["name"] for entry in self.description[group]]

    def start(self, group):
        """Start values of states, controls, disturbances or parameters."""
        return np.array([entry["start"] for entry in self.description[group]])

    def _vectors(self, values):
        vectors = [np.asarray(v, dtype=float).ravel() for v in values]
        for group, vector in zip(GROUPS, vectors, strict=True):
            if len(vector) != len(self.description[group]):
                expected = ", ".join(self.names(group)) or "none"
                raise ValueError(f"{group} are {len(vector)} numbers, expected: {expected}")
        return vectors

    def derivative(self, states, controls, disturbances, parameters=()):
        """Derivatives of the states per second at one point."""
        return self.programs["f"](*self._vectors((states, controls, disturbances, parameters)))

    def output(self, states, controls, disturbances, parameters=(), azimuth=None, field=()):
        """Outputs at one point; without an azimuth (rad) their average over a revolution."""
        vectors = self._vectors((states, controls, disturbances, parameters))
        if azimuth is None or "g_at_azimuth" not in self.programs:
            return self.programs["g"](*vectors)
        turning = np.array([float(azimuth)]), np.asarray(field, dtype=float)
        return self.programs["g_at_azimuth"](*vectors, *turning)

    def simulate(
        self, time, initial, controls, disturbances, parameters=(), azimuth=None, field=None
    ):
        """States and outputs at `time` (s), by one classical Runge-Kutta step between two times.

        Controls and disturbances have one row per time and go along lines between them, or are
        held where the model holds them. `azimuth` is the first one in rad, `field` has rows too.
        """
        rows = len(time)
        u, w = (np.asarray(v, dtype=float).reshape(rows, -1) for v in (controls, disturbances))
        inputs, kinds = (
            np.hstack([u, w]),
            [e["between_samples"] for g in GROUPS[1:3] for e in self.description[g]],
        )
        held, first = np.array([k == "hold" for k in kinds], dtype=bool), u.shape[1]
        x, states, psi = np.asarray(initial, dtype=float), [], [azimuth]

        def f(x, v):
            return self.derivative(x, v[:first], v[first:], parameters)

        turn = self.description.get("azimuth")
        at = None if turn is None else self.names("states").index(turn["speed"])
        for k in range(rows):
            states.append(x)
            if k + 1 == rows:
                break
            h, v0 = time[k + 1] - time[k], inputs[k]
            v1 = np.where(held, v0, inputs[k + 1])
            k1 = f(x, v0)
            k2 = f(x + 0.5 * h * k1, 0.5 * (v0 + v1))
            k3 = f(x + 0.5 * h * k2, 0.5 * (v0 + v1))
            k4 = f(x + h * k3, v1)
            new = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            if azimuth is not None and turn is not None:
                psi.append(psi[-1] + 0.5 * h * turn["rad/s"] * (x[at] + new[at]))
            x = new
        fields = [()] * rows if field is None else field
        angles = psi if len(psi) == rows else [None] * rows
        outputs = [
            self.output(states[k], u[k], w[k], parameters, angles[k], fields[k])
            for k in range(rows)
        ]
        return np.array(states), np.array(outputs)


if __name__ == "__main__":
    print(json.dumps(Model(*sys.argv[1:2]).description, indent=2))
