"""No corrective function."""

from __future__ import annotations

from typing import Literal

from dfsm.core.settings import settings_class
from dfsm.fitting.corrective.training import TrainingSet


@settings_class
class NoCorrection:
    """Leave the linear fit as it is."""

    kind: Literal["none"] = "none"

    def train(self, data: TrainingSet, seed: int) -> None:
        """Nothing is trained."""
