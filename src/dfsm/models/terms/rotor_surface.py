"""Thrust and torque of a rotor as smooth functions of every inflow, made of its table.

With v the wind at the rotor, u the speed of the blade tips and φ = atan2(κ v, u), forces are

    T = ½ ρ π R² (κ² v² + u²) C_T(φ, β)        C_T = Ct(λ, β) sin²φ / κ²,   λ = u / v

and likewise the torque. φ, from -90 to 90 deg, covers wind that dies away or turns around and a
rotor that stands still, without a division by v; κ, the tip speed ratio of largest power, spreads
the ratios of a table evenly. C_T and C_Q are uniform cubic B-splines: C² in (φ, β).

Beyond the table, where nothing is known, C_T continues

* above the largest λ, down to no wind, as T / u² = b0 + b1 v/u + b2 (v/u)²: value and slope of the
  table, b2 from its last rows, less where a rotor would give power without wind or where the force
  would fall with the wind; in wind from behind as b0 + b1 v/u where that falls, and
  thrust with the drag of standing blades;
* below the smallest λ, down to a rotor that stands, as an even polynomial of λ with the value and
  slope of the table, and drag downwind;
* beyond the pitch angles it levels off within eight steps of the pitch grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import scipy

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array
from dfsm.data.readers.rotor_table import RotorTable

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline

# Largest difference from the table's own spline, as a share of the largest coefficient at which
# the rotor takes power.
TOLERANCE = 1e-3
_CELLS = (128, 256, 512, 1024)
_MOST_PITCH = 256
# How the slope decays beyond the pitch axis, step by step, before it is zero.
_DECAY = (0.6, 0.36, 0.216, 0.1296)
_PAD = 8
# Share of the table's tip speed ratios from which the curvature at its upper end is taken.
_UPPER = 0.75
_FEWEST = 4
# Thrust coefficient of standing blades at least.
_LEAST_DRAG = 0.01


@dataclass(frozen=True)
class Grid:
    """Where the surfaces lie.

    Attributes
    ----------
    stretch
        κ.
    pitch_start, pitch_step
        First pitch angle that the splines cover, in deg, and the step between their knots.
    """

    stretch: float
    pitch_start: float
    pitch_step: float


def surface_values(
    weights: jax.Array, grid: Grid, wind: jax.Array, tip_speed: jax.Array, pitch: jax.Array
) -> jax.Array:
    """(κ² v² + u²) (C_T, C_Q), shape ``(2,)``, in m²/s²; see `surface`."""
    value = surface(weights, grid, wind, tip_speed, pitch)
    return value * ((grid.stretch * wind) ** 2 + tip_speed**2)


def surface(
    weights: jax.Array, grid: Grid, wind: jax.Array, tip_speed: jax.Array, pitch: jax.Array
) -> jax.Array:
    """Splines over the inflow's angle and the blades' pitch, shape ``(2,)``.

    Parameters
    ----------
    weights
        Of two splines, shape ``(2, cell + 3, pitch cell + 3)``.
    grid
        Where they lie.
    wind, tip_speed
        v and u in m/s, u above 0.
    pitch
        β in deg.
    """
    i, along = _basis(*_angle(weights.shape[1] - 3, grid, wind, tip_speed))
    j, across = _basis(*_pitch(weights.shape[2] - 3, grid, pitch))
    patch = jax.lax.dynamic_slice(weights, (jnp.int32(0), i, j), (2, 4, 4))
    # Sums of products instead of small matrix products, which cost a call each.
    return jnp.sum(patch * (along[:, None] * across), axis=(1, 2))


def surface_of_rows(
    flat: jax.Array,
    shape: tuple[int, int, int],
    grid: Grid,
    inflow: tuple[jax.Array, jax.Array, jax.Array],
) -> jax.Array:
    """`surface_values` of weights with both forces side by side, ``(cell + 3, pitch cell + 3, 2)``.

    All that is read of a row lies together, which a processor takes at once. The weights come as a
    flat array and their shape: XLA takes what is read of a part that was reshaped for all of it,
    and compiles no loop in one piece that seems to read so much.
    """
    (cells, pitches, count), (wind, tip_speed, pitch) = shape, inflow
    i, along = _basis(*_angle(cells - 3, grid, wind, tip_speed))
    j, across = _basis(*_pitch(pitches - 3, grid, pitch))
    parts = []
    for k in range(4):
        first = ((i + k) * pitches + j) * count
        part = jax.lax.dynamic_slice(flat, (first,), (4 * count,), allow_negative_indices=False)
        parts.append(along[k] * part)
    both = (parts[0] + parts[1] + parts[2] + parts[3]).reshape(4, count)
    value = across[0] * both[0] + across[1] * both[1] + across[2] * both[2] + across[3] * both[3]
    return value * ((grid.stretch * wind) ** 2 + tip_speed**2)


def _angle(cells: int, grid: Grid, wind: jax.Array, tip_speed: jax.Array) -> tuple[jax.Array, int]:
    """The inflow's angle in cells of the splines, and their number."""
    return (jnp.arctan2(grid.stretch * wind, tip_speed) / np.pi + 0.5) * cells, cells


def _pitch(cells: int, grid: Grid, pitch: jax.Array) -> tuple[jax.Array, int]:
    """The blade pitch in cells of the splines, and their number."""
    return (pitch - grid.pitch_start) / grid.pitch_step, cells


def _basis(at: jax.Array, cells: int) -> tuple[jax.Array, jax.Array]:
    """Cell of a coordinate, and the four cubic B-splines that are not zero there."""
    at = jnp.clip(at, 0.0, cells)
    cell = jnp.minimum(jnp.floor(at), cells - 1)
    t = at - cell
    s = 1 - t
    cubes = [s**3, 4 - 3 * t**2 * (1 + s), 4 - 3 * s**2 * (1 + t), t**3]
    return cell.astype(jnp.int32), jnp.stack(cubes) / 6


# -- making them --------------------------------------------------------------------------------


def make_surface(table: RotorTable) -> tuple[Array, Grid, float]:
    """Splines through a table.

    Returns
    -------
    tuple
        Weights for `surface_values`, their grid, and the largest difference from the table's own
        bicubic spline at its values and halfway between, as a share of the largest coefficient at
        which the rotor takes power.
    """
    stretch = max(table.optimum[0], float(table.tip_speed_ratio[1]))
    span = float(np.ptp(table.pitch))
    steps = round(span / float(np.diff(table.pitch).min()))
    pitch = np.linspace(table.pitch[0], table.pitch[-1], min(steps, _MOST_PITCH) + 1)
    step = float(pitch[1] - pitch[0])
    grid = Grid(stretch, float(pitch[0]) - _PAD * step, step)
    weights, error = np.zeros(0), np.inf
    for cells in _CELLS:
        angle = np.linspace(-np.pi / 2, np.pi / 2, cells + 1)
        values = np.stack(
            [
                _everywhere(table, c, angle, pitch, stretch, drag=k == 0)
                for k, c in enumerate((table.ct, table.cq))
            ]
        )
        weights = _padded(interpolating(interpolating(values, axis=1), axis=2))
        error = _error(table, weights, grid)
        if error <= TOLERANCE:
            break
    return weights, grid, error


def _everywhere(
    table: RotorTable, values: Array, angle: Array, pitch: Array, stretch: float, *, drag: bool
) -> Array:
    """One coefficient times sin²φ / κ² on the whole grid, shape ``(angle, pitch)``."""
    ratio = table.tip_speed_ratio
    spline = scipy.interpolate.RectBivariateSpline(ratio, table.pitch, values, kx=3, ky=3, s=0)
    low, high = ratio[0], ratio[-1]
    with np.errstate(divide="ignore"):
        at = np.where(angle > 0, stretch / np.tan(angle), np.inf)
    at[-1] = 0.0
    inflow = np.tan(angle) / stretch
    square = np.sin(angle)[:, None] ** 2 / stretch**2
    inside = spline(np.clip(at, low, high)[:, None], pitch, grid=False) * square
    standing = _standing(values, spline, low, pitch, drag=drag)
    slow = _even(spline, low, pitch, standing, at) * square
    fast = _fast(spline, ratio, pitch, inflow, positive_without_wind=drag)
    # At v < 0 the drag of standing blades, in its own normalisation: finite at u = 0.
    fast *= np.cos(angle)[:, None] ** 2
    if drag:
        fast -= np.where(angle < 0, 1.0, 0.0)[:, None] * standing * square
    return np.where((at < low)[:, None], slow, np.where((at > high)[:, None], fast, inside))


def _standing(
    values: Array, spline: RectBivariateSpline, low: float, pitch: Array, *, drag: bool
) -> Array:
    """Coefficient of a rotor that does not turn, shape ``(pitch,)``."""
    edge, slope = spline(low, pitch)[0], spline(low, pitch, dx=1)[0]
    size = float(np.abs(values).max())
    return np.clip(edge - slope * low / 2, _LEAST_DRAG if drag else -size, size)


def _even(
    spline: RectBivariateSpline, low: float, pitch: Array, standing: Array, at: Array
) -> Array:
    """Even polynomial from no rotation up to the smallest tip speed ratio, ``(at, pitch)``."""
    if low == 0:
        return np.broadcast_to(standing, (len(at), len(pitch)))
    rise = spline(low, pitch)[0] - standing
    quartic = (spline(low, pitch, dx=1)[0] * low - 2 * rise) / 2
    share = (np.minimum(at, low)[:, None] / low) ** 2
    return standing + (rise - quartic) * share + quartic * share**2


def _fast(
    spline: RectBivariateSpline,
    ratio: Array,
    pitch: Array,
    inflow: Array,
    *,
    positive_without_wind: bool,
) -> Array:
    """T / u² over v / u below that of the largest tip speed ratio, shape ``(inflow, pitch)``."""
    high = ratio[-1]
    end = 1 / high
    value = spline(high, pitch)[0] * end**2
    slope = 2 * end * spline(high, pitch)[0] - spline(high, pitch, dx=1)[0]
    sample = np.linspace(max(_UPPER * high, ratio[-_FEWEST]), high, 20)
    x = 1 / sample
    curvature = np.polyfit(x, spline(sample, pitch) * x[:, None] ** 2, 2)[0]
    # No force that falls with the wind, where the table's does not.
    curvature = np.minimum(curvature, np.maximum(slope, 0.0) / (2 * end))
    if not positive_without_wind:
        curvature = np.minimum(curvature, (slope * end - value) / end**2)
    # At φ = -90 deg x is without bounds; cos²φ x is zero there.
    x = np.maximum(inflow, -1e6)[:, None]
    ahead = np.clip(x, 0.0, end) - end
    forward = value + slope * ahead + curvature * ahead**2
    still, behind = slope - 2 * curvature * end, np.minimum(x, 0.0)
    # What falls with the wind would grow without bounds in wind from behind.
    return forward + behind * np.where(still > 0, still, still / (1 + (behind / end) ** 2))


def at_knots(weights: Array) -> Array:
    """Values of a spline at its knots, two less along each axis than `weights`."""
    for axis in (0, 1):
        w = np.moveaxis(weights, axis, 0)
        weights = np.moveaxis((w[:-2] + 4 * w[1:-1] + w[2:]) / 6, 0, axis)
    return weights


def interpolating(values: Array, axis: int) -> Array:
    """Weights of the cubic B-splines through values on a uniform grid, two more than those.

    The third derivative is continuous across the first and the last knot inside, so that cubics
    are reproduced.
    """
    moved = np.moveaxis(values, axis, 0)
    n = len(moved)
    matrix, right = np.zeros((n + 2, n + 2)), np.zeros((n + 2, *moved.shape[1:]))
    for i in range(n):
        matrix[i + 1, i : i + 3] = 1 / 6, 4 / 6, 1 / 6
    matrix[0, :5] = matrix[-1, -5:] = 1, -4, 6, -4, 1
    right[1:-1] = moved
    solution = np.linalg.solve(matrix, right.reshape(n + 2, -1))
    return np.moveaxis(solution.reshape(right.shape), 0, axis)


def _padded(weights: Array) -> Array:
    """More weights along the pitch, whose slope decays until they are all the same."""
    decay = np.cumsum([*_DECAY, *[0.0] * (_PAD - len(_DECAY))])
    first, last = weights[..., :1], weights[..., -1:]
    before = first + (first - weights[..., 1:2]) * decay[::-1]
    after = last + (last - weights[..., -2:-1]) * decay
    return np.concatenate([before, weights, after], axis=-1)


def _error(table: RotorTable, weights: Array, grid: Grid) -> float:
    ratio, pitch = (_halved(axis) for axis in (table.tip_speed_ratio, table.pitch))
    ratio = ratio[ratio > 0]
    wind = 1 / ratio[:, None] * np.ones(len(pitch))
    arrays = (wind.ravel(), np.ones(wind.size), np.tile(pitch, len(ratio)))
    on_grid = jax.jit(jax.vmap(lambda *at: surface_values(jnp.asarray(weights), grid, *at)))
    ours = np.asarray(on_grid(*arrays)).T.reshape(2, *wind.shape) / wind**2
    takes = table.cp > 0
    errors = []
    for mine, values in zip(ours, (table.ct, table.cq), strict=True):
        spline = scipy.interpolate.RectBivariateSpline(
            table.tip_speed_ratio, table.pitch, values, s=0
        )
        exact = spline(ratio, pitch)
        errors.append(np.abs(mine - exact).max() / np.abs(values[takes]).max())
    return float(max(errors))


def _halved(axis: Array) -> Array:
    return np.sort(np.concatenate([axis, (axis[1:] + axis[:-1]) / 2]))
