"""How a model is refined on rollouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

from dfsm.core.settings import require, settings_class
from dfsm.data.hold_out import HoldOut, checked


@settings_class
class RefineSettings:
    """How a model is refined on rollouts.

    Attributes
    ----------
    windows
        Lengths of the rollouts in s, one stage after the other; None is a whole run.
    step
        Integration step in s; inputs are averaged over it.
    latents
        Number of latent states to add to a model that has none, an even number, see `latents.py`.
    latent_inputs
        Controls and disturbances that drive them; None takes all. Where a controller chose the
        controls and other gains or an optimum are asked for, disturbances alone should.
    network
        Hidden units of a tanh network to add to a derivative function that is not corrected; what
        derivatives do not show, rollouts may. `fit` then corrects outputs only.
    iterations
        Largest number of Levenberg-Marquardt steps per stage.
    decay
        Weight of the squared deviations from the start, in which a unit changes a derivative by
        about its own spread, beside the sum of squared errors relative to their spread.
    hold_out
        Share of the runs that decide when to stop, at least one; last of all they train, too. Or a
        `HoldOut`, which leaves out whole operating points, several times if asked for.
    correlation
        Between the errors of runs that have the same disturbances and differ in their controls:
        at 0.8, the difference of two such runs counts five times and their mean about half, see
        `rollout_error.py`, and both are held out or neither is. 0 takes all runs as unrelated.
    weights
        Weight of a state's squared error, by name; 1 for all others.
    seconds
        No further step is begun after this time; None sets no limit.
    """

    windows: tuple[float | None, ...] = (20.0, 100.0, None)
    step: float = 0.25
    iterations: int = 20
    latents: int = 0
    latent_inputs: tuple[str, ...] | None = None
    network: int = 0
    decay: float = 0.0
    hold_out: float | HoldOut = 0.2
    correlation: float = 0.0
    weights: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None

    def __post_init__(self) -> None:
        require(bool(self.windows), "refine.windows", self.windows, "at least one length")
        for length in self.windows:
            good = length is None or length > self.step
            require(good, "refine.windows", length, "lengths in s, longer than refine.step")
        require(self.step > 0, "refine.step", self.step, "more than 0 s")
        even = self.latents >= 0 and self.latents % 2 == 0
        require(even, "refine.latents", self.latents, "an even number: they come in pairs")
        some = self.latent_inputs is None or len(self.latent_inputs) > 0
        require(some, "refine.latent_inputs", self.latent_inputs, "at least one name, or null")
        require(self.network >= 0, "refine.network", self.network, "a number of units, or 0")
        require(self.decay >= 0, "refine.decay", self.decay, "0 or more")
        require(self.iterations >= 1, "refine.iterations", self.iterations, "at least 1")
        checked(self.hold_out, "refine.hold_out")
        good = 0 <= self.correlation < 1
        require(good, "refine.correlation", self.correlation, "at least 0 and less than 1")
        for name, weight in self.weights.items():
            require(weight >= 0, f"refine.weights.{name}", weight, "0 or more")
