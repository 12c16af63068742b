"""A model as one file of C99 and its header, without dependencies but for the C library."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dfsm.core.files import check_folder, visible, write_folder
from dfsm.core.version import __version__
from dfsm.exports.casadi_model import c_functions
from dfsm.exports.functions import GROUPS, description
from dfsm.exports.identifiers import comment, identifier, numbers, strings
from dfsm.models.dfsm import DFSM

_MARK = "/* Made by dfsm"
_GROUPS = (*GROUPS, "outputs", "field")


@dataclass(frozen=True)
class CSource:
    """Two files.

    Attributes
    ----------
    name
        Prefix of everything that the files define, and their name.
    header, source
        What stands in ``<name>.h`` and ``<name>.c``.
    description
        Names, units and start values, see `CasadiModel`.
    """

    name: str
    header: str
    source: str
    description: dict[str, Any]


def to_c(model: DFSM, name: str = "model") -> CSource:
    """Write a model down in C99.

    Parameters
    ----------
    model
        Any model; terms may be functions of one's own.
    name
        Prefix of all names in C; what C cannot have in a name becomes an underscore.

    Returns
    -------
    CSource
        ``<name>_derivative`` and ``<name>_output``, which equal `DFSM.derivative` and
        `DFSM.output` up to rounding, ``<name>_step``, one step of RK4, and names, units and start
        values as arrays.

    Raises
    ------
    DfsmError
        A term is a function with something in it that has no counterpart; names both.
    """
    name = identifier(name)
    code, sizes = c_functions(model, name)
    told = description(model)
    turning = "g_at_azimuth" in sizes
    header = _header(name, told, turning=turning)
    parts = [f'{_first(name)}\n#include "{name}.h"\n', code, _arrays(name, told)]
    parts += [_call(name, "f", "derivative", sizes["f"]), _call(name, "g", "output", sizes["g"])]
    if turning:
        parts.append(_call(name, "g_at_azimuth", "output_at_azimuth", sizes["g_at_azimuth"]))
    parts.append(_STEP.replace("NAME", name).replace("UPPER", name.upper()))
    return CSource(name, header, "\n".join(parts), told)


def write_c(model: DFSM, path: str | Path, name: str | None = None) -> CSource:
    """Write ``<name>.c`` and ``<name>.h`` into a folder.

    Parameters
    ----------
    model
        See `to_c`.
    path
        Folder to make; one that dfsm wrote such files into is replaced.
    name
        See `to_c`; None takes the folder's.

    Raises
    ------
    DfsmError
        The folder holds something else or cannot be written, and as for `to_c`.
    """
    path = Path(path)
    check_folder(path, is_ours=_is_ours)
    made = to_c(model, path.resolve().name if name is None else name)
    with write_folder(path, is_ours=_is_ours) as folder:
        (folder / f"{made.name}.h").write_text(made.header, encoding="ascii")
        (folder / f"{made.name}.c").write_text(made.source, encoding="ascii")
    return made


def _is_ours(path: Path) -> bool:
    names = visible(path)
    if sorted(Path(n).suffix for n in names) != [".c", ".h"]:
        return False
    return all((path / n).read_bytes().startswith(_MARK.encode()) for n in names)


def _first(name: str) -> str:
    return f"{_MARK} {__version__}: the model {name}, C99. */"


def _header(name: str, told: dict[str, Any], *, turning: bool) -> str:
    upper = name.upper()
    lines = [_first(name), f"#ifndef {upper}_H", f"#define {upper}_H", ""]
    lines += [f"#define {upper}_{g.upper()} {len(told[g])}" for g in _GROUPS]
    lines += ["", "/*", *_vectors(told), "*/", ""]
    lines += ["#ifdef __cplusplus", 'extern "C" {', "#endif", ""]
    for group in _GROUPS:
        lines += [f"extern const char *const {name}_{group}_names[];"]
        lines += [f"extern const char *const {name}_{group}_units[];"]
    lines += [f"extern const double {name}_{g}_starts[];" for g in GROUPS]
    functions = _DECLARATIONS + (_TURNING if turning else "")
    lines += [functions.replace("NAME", name), "#ifdef __cplusplus", "}", "#endif", "#endif", ""]
    return "\n".join(lines)


def _vectors(told: dict[str, Any]) -> list[str]:
    """What the elements of all vectors are, as lines of a comment."""
    lines = list[str]()
    for group in _GROUPS:
        if told[group]:
            lines.append(f"{group}:")
        for k, entry in enumerate(told[group]):
            unit = f" ({comment(entry['unit'])})" if entry["unit"] else ""
            kind = entry.get("between_samples")
            between = f", {kind} between samples" if kind else ""
            lines.append(f"  [{k}] {comment(entry['name'])}{unit}{between}")
    if told["latent_states"]:
        names = comment(", ".join(told["latent_states"]))
        lines += textwrap.wrap(
            f"Nobody measures {names}; start values: {told['latent_starts']}", 96
        )
    if told["step"] is not None:
        lines.append(f"Longest step: {told['step']:.6g} s.")
    for sentence in told["computed_inputs"]:
        lines += textwrap.wrap(comment(sentence), 96)
    return lines


def _arrays(name: str, told: dict[str, Any]) -> str:
    parts = list[str]()
    for group in _GROUPS:
        parts.append(strings(f"{name}_{group}_names", [e["name"] for e in told[group]]))
        parts.append(strings(f"{name}_{group}_units", [e["unit"] for e in told[group]]))
    parts += [numbers(f"{name}_{g}_starts", [e["start"] for e in told[g]]) for g in GROUPS]
    return "".join(parts)


def _call(name: str, short: str, long: str, sizes: tuple[int, int, int, int]) -> str:
    """The function with plain arguments around the one that CasADi wrote."""
    arg, res, iw, w = (max(1, s) for s in sizes)
    turning = short == "g_at_azimuth"
    result = "derivatives" if short == "f" else "outputs"
    more = ", double azimuth, const double *field" if turning else ""
    given = ", &azimuth, field" if turning else ""
    return f"""int {name}_{long}(const double *states, const double *controls,
    const double *disturbances, const double *parameters{more}, double *{result}) {{
  const double *arg[{arg}] = {{states, controls, disturbances, parameters{given}}};
  double *res[{res}] = {{{result}}};
  casadi_int iw[{iw}];
  double w[{w}];
  return {name}_{short}(arg, res, iw, w, 0);
}}
"""


_DECLARATIONS = """
/* Derivatives of the states per second. All functions return 0; vectors without elements may be
   null pointers. */
int NAME_derivative(const double *states, const double *controls, const double *disturbances,
    const double *parameters, double *derivatives);

/* Outputs; of a model with blade-passing harmonics their average over a revolution. */
int NAME_output(const double *states, const double *controls, const double *disturbances,
    const double *parameters, double *outputs);

/* One classical Runge-Kutta step of so many seconds. Controls and disturbances go along straight
   lines from their values at its start to those at its end; give one that is held twice. `next`
   may be `states`. */
int NAME_step(double seconds, const double *states,
    const double *controls_start, const double *disturbances_start,
    const double *controls_end, const double *disturbances_end,
    const double *parameters, double *next);
"""
_TURNING = """
/* Outputs at an azimuth in rad, in a wind field with these harmonics. */
int NAME_output_at_azimuth(const double *states, const double *controls,
    const double *disturbances, const double *parameters, double azimuth, const double *field,
    double *outputs);
"""
_STEP = """int NAME_step(double seconds, const double *states,
    const double *controls_start, const double *disturbances_start,
    const double *controls_end, const double *disturbances_end,
    const double *parameters, double *next) {
  double k[4][UPPER_STATES], x[UPPER_STATES];
  double u[UPPER_CONTROLS + 1], w[UPPER_DISTURBANCES + 1];
  static const double shares[4] = {0.0, 0.5, 0.5, 1.0};
  int i, s, failed;
  for (s = 0; s < 4; ++s) {
    const double share = shares[s];
    for (i = 0; i < UPPER_STATES; ++i) {
      x[i] = s ? states[i] + share * seconds * k[s - 1][i] : states[i];
    }
    for (i = 0; i < UPPER_CONTROLS; ++i) {
      u[i] = (1.0 - share) * controls_start[i] + share * controls_end[i];
    }
    for (i = 0; i < UPPER_DISTURBANCES; ++i) {
      w[i] = (1.0 - share) * disturbances_start[i] + share * disturbances_end[i];
    }
    failed = NAME_derivative(x, u, w, parameters, k[s]);
    if (failed) return failed;
  }
  for (i = 0; i < UPPER_STATES; ++i) {
    next[i] = states[i] + seconds / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
  }
  return 0;
}
"""
