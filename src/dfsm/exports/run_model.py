"""Evaluate and simulate the model that was exported beside this file; it needs NumPy alone.

    from run_model import Model

    model = Model("model.npz")
    model.derivative(states, controls, disturbances, parameters)    # per second
    model.output(states, controls, disturbances, parameters)
    model.distance(states, controls, disturbances, parameters)    # more than 1: not in the data
    states, outputs = model.simulate(time, initial, controls, disturbances, parameters)

Names, units and start values of all vectors, in order, stand in `model.description`.
`python run_model.py` prints them. Made by dfsm; the numbers are in model.npz, nothing is executed.
"""

import json
import math
import sys

import numpy as np

GROUPS = ("states", "controls", "disturbances", "parameters")
APPLY = {
    **{n: getattr(np, n) for n in ("abs", "sign", "floor", "ceil", "sqrt", "exp", "log", "log1p")},
    **{n: getattr(np, n) for n in ("expm1", "sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"a{n}": getattr(np, f"arc{n}") for n in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{"neg": np.negative, "add": np.add, "sub": np.subtract, "mul": np.multiply},
    **{"div": np.divide, "pow": np.power, "rem": np.fmod, "atan2": np.arctan2},
    **{"max": np.maximum, "min": np.minimum, "lt": np.less, "le": np.less_equal},
    **{"gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal},
    **{"and": np.logical_and, "or": np.logical_or, "not": np.logical_not},
    "erf": np.vectorize(math.erf, otypes=[float]),
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
            return (lambda *v: APPLY[what](*v) * 1.0), of
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


def between(time, values, kinds):
    """Inputs as a function of the place of a sample and the time (s) since it."""
    h, moves = np.diff(time)[:, None], np.diff(values, axis=0)
    kinds, slope, bend = np.array(kinds), np.zeros_like(moves), np.zeros((2, *moves.shape))
    slope[:, kinds == "linear"] = (moves / np.where(h > 0, h, np.inf))[:, kinds == "linear"]
    if (smooth := kinds == "cubic").any() and len(time) > 1:
        d = moves[:, smooth] / h
        s = spline_slopes(h, d)
        slope[:, smooth] = s[:-1]
        bend[0][:, smooth] = (3 * d - 2 * s[:-1] - s[1:]) / h
        bend[1][:, smooth] = (s[:-1] + s[1:] - 2 * d) / h**2
    return lambda k, t: values[k] + t * (slope[k] + t * (bend[0][k] + t * bend[1][k]))


def spline_slopes(h, d):
    """Slopes of a cubic spline without knots at the second sample and the last but one."""
    n = len(h) + 1
    if n < 4 or h.min() <= 1e-6 * h.mean():
        raise ValueError("inputs that are splines need four times or more, well apart")
    low, main, high = np.zeros((3, n, 1))
    low[1:-1], main[1:-1], high[1:-1] = h[1:], 2 * (h[:-1] + h[1:]), h[:-1]
    right = np.empty((n, d.shape[1]))
    right[1:-1] = 3 * (h[1:] * d[:-1] + h[:-1] * d[1:])
    for i, (a, b), (p, q) in ((0, h[:2], d[:2]), (-1, h[:-3:-1], d[:-3:-1])):
        main[i], right[i] = b, ((3 * a + 2 * b) * b * p + a**2 * q) / (a + b)
    high[0], low[-1] = h[0] + h[1], h[-1] + h[-2]
    for i in range(1, n):
        share = low[i] / main[i - 1]
        main[i], right[i] = main[i] - share * high[i - 1], right[i] - share * right[i - 1]
    right[-1] /= main[-1]
    for i in range(n - 2, -1, -1):
        right[i] = (right[i] - high[i] * right[i + 1]) / main[i]
    return right


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

    def distance(self, states, controls, disturbances, parameters=()):
        """How far a point is from the training data: up to 1 inside them."""
        return self.programs["d"](*self._vectors((states, controls, disturbances, parameters)))[0]

    def simulate(
        self, time, initial, controls, disturbances, parameters=(), azimuth=None, field=None
    ):
        """States and outputs at `time` (s), by classical Runge-Kutta steps.

        Controls and disturbances have one row per time; between two they do what the description
        says (`between_samples`). One step leads from time to time, or several where it names a
        shorter `step`. `azimuth` is the first one in rad, `field` has rows too.
        """
        rows, h = len(time), np.diff(time)
        if not (h >= 0).all():
            raise ValueError("times go back, or are no numbers: give them in order")
        u, w = (np.asarray(v, dtype=float).reshape(rows, -1) for v in (controls, disturbances))
        kinds = [e["between_samples"] for g in GROUPS[1:3] for e in self.description[g]]
        inputs, first = between(np.asarray(time, dtype=float), np.hstack([u, w]), kinds), u.shape[1]
        x, states, psi = np.asarray(initial, dtype=float), [], [azimuth]
        parts = math.ceil(h.max(initial=0) / (self.description["step"] or np.inf) * (1 - 1e-9)) or 1

        def f(x, v):
            return self.derivative(x, v[:first], v[first:], parameters)

        turn = self.description.get("azimuth")
        at = None if turn is None else self.names("states").index(turn["speed"])
        for k in range(rows):
            states.append(x)
            if azimuth is not None and turn is not None and k:
                psi.append(azimuth)
            for part in range(parts if k + 1 < rows else 0):
                s, since = h[k] / parts, h[k] / parts * part
                v0, v1, v2 = (inputs(k, since + share * s) for share in (0.0, 0.5, 1.0))
                k1 = f(x, v0)
                k2 = f(x + 0.5 * s * k1, v1)
                k3 = f(x + 0.5 * s * k2, v1)
                k4 = f(x + s * k3, v2)
                new = x + s / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                if azimuth is not None and turn is not None:
                    azimuth = azimuth + 0.5 * s * turn["rad/s"] * (x[at] + new[at])
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
