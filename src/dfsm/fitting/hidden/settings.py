"""How a model with hidden states is fitted."""

from __future__ import annotations

from typing import Literal

from dfsm.core.settings import require, settings_class
from dfsm.models.terms.sensor import Sensing

# More hidden states than that no record of one output has told apart.
_MOST = 20


@settings_class
class HiddenSettings:
    """How a model whose states are not all measured is fitted on rollouts.

    Attributes
    ----------
    count
        Number of hidden states beside the measured ones; None chooses it on data left out.
    most
        Largest number that is tried where `count` is None.
    form
        What corrects all rows: ``"polynomial"``, ``"tanh"`` or ``"none"``; None takes what is best
        on data left out.
    output
        What instruments make of what they see: ``"direct"``, ``"absolute"`` or ``"square"``, which
        lose its sign, or ``"clipped"``, which end at the ends of the record; None takes what is
        best on data left out, where a record looks like one of these.
    units
        Tanh units.
    degree
        Of the polynomial; products of more than are worth it are left out.
    starts
        Draws of the tanh units, of which the best on data left out is kept.
    iterations
        Largest number of Levenberg-Marquardt steps per start.
    startup
        Length in s of the past from which hidden states are told in use; None takes 50 samples.
    samples
        Most samples that the search looks at; the last steps see all.
    decay
        Weight of the squared parameters, in which one changes a rate by about its spread per
        sample, beside squared errors relative to what they are on average.
    stable
        Where set, states of any two rollouts come together at this rate in 1/s at least, whatever
        is learned; for the form ``"tanh"`` or ``"none"``.
    """

    count: int | None = None
    most: int = 5
    form: Literal["polynomial", "tanh", "none"] | None = None
    output: Sensing | None = None
    units: int = 6
    degree: int = 3
    starts: int = 10
    iterations: int = 40
    startup: float | None = None
    samples: int = 6000
    decay: float = 10.0
    stable: float | None = None

    def __post_init__(self) -> None:
        if self.count is not None:
            good = 0 <= self.count <= _MOST
            require(good, "hidden.count", self.count, f"a number from 0 to {_MOST}, or null")
        require(0 <= self.most <= _MOST, "hidden.most", self.most, f"a number from 0 to {_MOST}")
        require(self.units >= 1, "hidden.units", self.units, "at least 1")
        require(2 <= self.degree <= 5, "hidden.degree", self.degree, "2 to 5")
        require(self.starts >= 1, "hidden.starts", self.starts, "at least 1")
        require(self.iterations >= 1, "hidden.iterations", self.iterations, "at least 1")
        long = self.startup is None or self.startup > 0
        require(long, "hidden.startup", self.startup, "more than 0 s, or null")
        require(self.samples >= 100, "hidden.samples", self.samples, "at least 100")
        require(self.decay >= 0, "hidden.decay", self.decay, "0 or more")
        positive = self.stable is None or self.stable > 0
        require(positive, "hidden.stable", self.stable, "more than 0 1/s, or null")
        fits = self.stable is None or self.form != "polynomial"
        require(fits, "hidden.form", self.form, "tanh or none beside hidden.stable")
