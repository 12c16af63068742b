"""Units of channels: which texts mean the same, and what converts one into another.

A channel keeps its unit as the file writes it; only here is such a text read. Spellings of the
field are understood: ``kN-m``, ``kN·m``, ``kN m`` and ``kNm``; ``m/sec``; ``rad s^-1``;
``deg/s2``; ``(-)``. A word that is not in the table is a unit of its own, equal to itself only.

A table of our own instead of pint 0.25, which was tried: it reads ``kN-m`` as a subtraction and
knows neither ``m/s2`` nor ``-``, so that most of this parser would stand in front of it; it counts
rad as no dimension and takes 1 rad/s for 1 Hz, which would pass a wrong number; and its first
use costs 0.5 s, as much as a command that prints a table.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache

# What tells that nobody knows the unit; "-" is not among them, it says that there is none to know.
_UNKNOWN = {"", "?", "n/a", "na", "none", "unknown"}

_Powers = dict[str, float]
_LENGTH, _TIME, _ANGLE, _MASS, _HEAT = ({b: 1.0} for b in ("m", "s", "rad", "kg", "K"))
_SPEED = {"m": 1.0, "s": -1.0}
_FREQUENCY = {"s": -1.0}
_TURNING = {"rad": 1.0, "s": -1.0}
_FORCE = {"kg": 1.0, "m": 1.0, "s": -2.0}
_PRESSURE = {"kg": 1.0, "m": -1.0, "s": -2.0}
_ENERGY = {"kg": 1.0, "m": 2.0, "s": -2.0}
_POWER = {"kg": 1.0, "m": 2.0, "s": -3.0}
_VOLTAGE = _POWER | {"A": -1.0}

_BASES = {*("m", "s", "rad", "kg", "K", "A", "mol", "VA", "var", "cd")}

# Units that take a prefix: what one is in m, s, rad, kg, K and A, and its powers of these. Angles
# have a dimension of their own: a speed of rotation is no frequency, though both are "per second".
_PREFIXABLE: dict[str, tuple[float, _Powers]] = {
    "m": (1.0, _LENGTH),
    "s": (1.0, _TIME),
    "sec": (1.0, _TIME),
    "g": (1e-3, _MASS),
    "rad": (1.0, _ANGLE),
    "deg": (math.pi / 180, _ANGLE),
    "K": (1.0, _HEAT),
    "A": (1.0, {"A": 1.0}),
    "V": (1.0, _VOLTAGE),
    "Ohm": (1.0, _VOLTAGE | {"A": -2.0}),
    "Hz": (1.0, _FREQUENCY),
    "N": (1.0, _FORCE),
    "Nm": (1.0, _ENERGY),
    "Pa": (1.0, _PRESSURE),
    "bar": (1e5, _PRESSURE),
    "J": (1.0, _ENERGY),
    "W": (1.0, _POWER),
    "Wh": (3600.0, _ENERGY),
    "Ah": (3600.0, {"A": 1.0, "s": 1.0}),
    "L": (1e-3, {"m": 3.0}),
    "l": (1e-3, {"m": 3.0}),
    "mol": (1.0, {"mol": 1.0}),
    # Apparent and reactive power are no power.
    "VA": (1.0, {"VA": 1.0}),
    "var": (1.0, {"var": 1.0}),
    "cd": (1.0, {"cd": 1.0}),
}
_PREFIXES = {
    "n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "h": 1e2, "k": 1e3, "K": 1e3,
    "M": 1e6, "G": 1e9, "T": 1e12,
}  # fmt: skip
_NAMED: dict[str, tuple[float, _Powers]] = {
    **dict.fromkeys(("metre", "meter", "metres", "meters"), (1.0, _LENGTH)),
    **dict.fromkeys(("in", "inch"), (0.0254, _LENGTH)),
    **dict.fromkeys(("ft", "foot", "feet"), (0.3048, _LENGTH)),
    **dict.fromkeys(("mile", "miles"), (1609.344, _LENGTH)),
    **dict.fromkeys(("second", "seconds", "secs"), (1.0, _TIME)),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), (60.0, _TIME)),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), (3600.0, _TIME)),
    **dict.fromkeys(("d", "day", "days"), (86400.0, _TIME)),
    **dict.fromkeys(("radian", "radians"), (1.0, _ANGLE)),
    **dict.fromkeys(("degree", "degrees"), (math.pi / 180, _ANGLE)),
    **dict.fromkeys(("r", "rev", "revs", "turn", "turns"), (2 * math.pi, _ANGLE)),
    "rpm": (math.pi / 30, _TURNING),
    "rps": (2 * math.pi, _TURNING),
    "dps": (math.pi / 180, _TURNING),
    **dict.fromkeys(("kn", "kt", "kts", "knot", "knots"), (1852 / 3600, _SPEED)),
    **dict.fromkeys(("kmh", "kph", "kmph"), (1 / 3.6, _SPEED)),
    "mph": (0.44704, _SPEED),
    **dict.fromkeys(("t", "tonne", "tonnes"), (1e3, _MASS)),
    **dict.fromkeys(("lb", "lbs", "lbm"), (0.45359237, _MASS)),
    "kgf": (9.80665, _FORCE),
    "lbf": (0.45359237 * 9.80665, _FORCE),
    **dict.fromkeys(("volt", "volts"), (1.0, _VOLTAGE)),
    **dict.fromkeys(("amp", "amps", "ampere", "amperes"), (1.0, {"A": 1.0})),
    **dict.fromkeys(("watt", "watts"), (1.0, _POWER)),
    **dict.fromkeys(("newton", "newtons"), (1.0, _FORCE)),
    **dict.fromkeys(("pascal", "pascals"), (1.0, _PRESSURE)),
    **dict.fromkeys(("liter", "liters", "litre", "litres"), (1e-3, {"m": 3.0})),
    # Mechanical horsepower, and gallons of the United States.
    "hp": (550 * 0.3048 * 0.45359237 * 9.80665, _POWER),
    **dict.fromkeys(("gal", "gallon", "gallons"), (3.785411784e-3, {"m": 3.0})),
    "gpm": (3.785411784e-3 / 60, {"m": 3.0, "s": -1.0}),
    **dict.fromkeys(("mmHg", "torr"), (133.322387415, _PRESSURE)),
    "psi": (0.45359237 * 9.80665 / 0.0254**2, _PRESSURE),
    "atm": (101325.0, _PRESSURE),
    "Ncm": (1e-2, _ENERGY),
    "Nmm": (1e-3, _ENERGY),
    "Nms": (1.0, _ENERGY | {"s": -1.0}),
    "kelvin": (1.0, _HEAT),
    "degC": (1.0, _HEAT),
    "degF": (5 / 9, _HEAT),
    **dict.fromkeys(("%", "percent", "pct"), (1e-2, {})),
    **dict.fromkeys(("unitless", "dimensionless"), (1.0, {})),
}
# Kelvin at zero of a scale of temperatures; it counts where the temperature is all of the unit.
_ZERO = {"degC": 273.15, "degF": 273.15 - 32 * 5 / 9}
# In any case: RPM, Deg, Sec. Shorter ones, and prefixes, mean other things in other cases.
_WORDS = {n.lower(): n for n in (*_PREFIXABLE, *_NAMED) if len(n) > 2 and n not in ("Ohm", "Nms")}

_REWRITTEN = (
    # º, the ordinal, stands on keyboards where ° does not.
    (re.compile("º"), "°"),
    (re.compile(r"(°|[Dd]egrees?|[Dd]eg\.?)\s*(C|Celsius)\b|℃|\b[Cc]elsius\b|^\s*C\s*$"), "degC"),
    (re.compile(r"(°|[Dd]egrees?|[Dd]eg\.?)\s*(F|Fahrenheit)\b|℉|\b[Ff]ahrenheit\b"), "degF"),
    (re.compile("°"), " deg "),
    (re.compile("[µμ]"), "u"),
    (re.compile("[ΩΩ]"), "Ohm"),
    (re.compile("[−–]"), "-"),
    (re.compile("[·⋅∙•×]"), "."),
    (re.compile(r"\*\*"), "^"),
    (re.compile(r"\bper\b"), "/"),
    (re.compile(r"\^\s*[({]\s*([-+]?\d+)\s*[)}]"), r"^\1"),
)
_SUPERSCRIPTS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)|(?P<name>[^\W\d_]+|%)|(?P<sign>[-./*()])|"
    r"(?P<other>\S))"
)
_POWER_SIGN = re.compile(r"\s*\^\s*([-+]?\d+(?:\.\d+)?)|(-?\d+)")


@dataclass(frozen=True)
class Unit:
    """What a text means: a value x in it is ``factor x + zero`` in powers of base units."""

    factor: float
    zero: float
    powers: tuple[tuple[str, float], ...]


def known(text: str) -> bool:
    """Whether a text says anything about the unit."""
    return _bare(text).lower() not in _UNKNOWN


def listed(text: str) -> bool:
    """Whether a text is a unit of the table here, or made of some: a word of its own is none."""
    return known(text) and all(base in _BASES for base, _ in _read(_bare(text)).powers)


def powers(text: str) -> dict[str, float]:
    """Powers of m, s, rad, kg, K, A, mol, VA, var and cd that a unit is made of.

    A word that is not in the table is a base of its own.
    """
    return dict(_read(_bare(text)).powers)


def conversion(source: str, target: str) -> tuple[float, float] | None:
    """Factor and summand that take values in one unit to another, None between dimensions."""
    a, b = _read(_bare(source)), _read(_bare(target))
    if a.powers != b.powers:
        return None
    if (a.factor, a.zero) == (b.factor, b.zero):
        return 1.0, 0.0
    return a.factor / b.factor, (a.zero - b.zero) / b.factor


def factor(source: str, target: str) -> float | None:
    """What one `source` is in `target`; None between dimensions, and of an unknown unit."""
    change = conversion(source, target) if known(source) else None
    return None if change is None else change[0]


def agree(a: str, b: str) -> bool:
    """Whether two units are the same, however they are spelled; an unknown one agrees with all."""
    if a == b or not (known(a) and known(b)):
        return True
    change = conversion(a, b)
    return change is not None and abs(change[0] - 1) < 1e-12 and not change[1]


def _bare(text: str) -> str:
    """Without brackets around all of it."""
    text = text.strip()
    while len(text) > 1 and text[0] + text[-1] in ("()", "[]"):
        inner = text[1:-1]
        if any(sign in inner for sign in "()[]"):
            break
        text = inner.strip()
    return text


@lru_cache(maxsize=1024)
def _read(text: str) -> Unit:
    for pattern, put in _REWRITTEN:
        text = pattern.sub(put, text)
    text = re.sub("[⁻⁰¹²³⁴-⁹]+", lambda m: "^" + m[0].translate(_SUPERSCRIPTS), text).strip()
    if text == "-":
        return Unit(1.0, 0.0, ())
    if text in _ZERO:
        scale, powers = _NAMED[text]
        return Unit(scale, _ZERO[text], tuple(powers.items()))
    try:
        scale, powers, end = _product(text, 0)
    except _NoUnitError:
        scale, powers, end = 1.0, _Powers(), -1
    if end != len(text):
        # Something else than a unit in brackets: nothing is known but its letters.
        return Unit(1.0, 0.0, ((" ".join(text.split()), 1.0),))
    kept = {base: p for base, p in powers.items() if p}
    return Unit(scale, 0.0, tuple(sorted(kept.items())))


class _NoUnitError(Exception):
    pass


def _product(text: str, at: int) -> tuple[float, _Powers, int]:
    """Read products and quotients from a place on, up to the end or a closing bracket.

    What is joined by ``-``, a dot or a space behind a slash belongs below it, as in ``J/kg-K``;
    ``*`` leads back above, as in formulas.
    """
    scale, powers, sign, expected = 1.0, _Powers(), 1, True
    while match := _TOKEN.match(text, at):
        mark = match["sign"]
        if match["other"] is not None:
            raise _NoUnitError
        if mark == ")":
            break
        if mark in ("-", ".", "/", "*"):
            at, expected = match.end(), mark != "."  # a dot may end an abbreviation
            sign = -1 if mark == "/" else 1 if mark == "*" else sign
            continue
        if mark == "(":
            value, part, at = _product(text, match.end())
            closing = _TOKEN.match(text, at)
            if closing is None or closing["sign"] != ")":
                raise _NoUnitError
            at = closing.end()
        elif match["number"] is not None:
            value, part, at = float(match["number"]), {}, match.end()
        else:
            (value, part), at = _named(match["name"]), match.end()
        power = 1.0
        if raised := _POWER_SIGN.match(text, at):
            power, at = float(raised[1] or raised[2]), raised.end()
        power, expected = sign * power, False
        scale *= value**power
        for base, p in part.items():
            powers[base] = powers.get(base, 0.0) + p * power
    if expected:
        raise _NoUnitError
    return scale, powers, len(text.rstrip()) if not text[at:].strip() else at


def _named(name: str) -> tuple[float, _Powers]:
    for table in (_NAMED, _PREFIXABLE):
        if name in table:
            return table[name]
    if name[:1] in _PREFIXES and name[1:] in _PREFIXABLE:
        scale, powers = _PREFIXABLE[name[1:]]
        return _PREFIXES[name[0]] * scale, powers
    word = _WORDS.get(name.lower())
    return _named(word) if word is not None else (1.0, {name: 1.0})
