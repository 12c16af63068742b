"""What is no model, as the result of a fit, is refused in one sentence wherever it is taken."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dfsm
from dfsm.data.trajectory import Channel

TIME = np.linspace(0, 1, 11)
RUN = dfsm.Trajectory(TIME, np.zeros((11, 1)), (Channel("x", "m"),))


@pytest.mark.parametrize(
    "call",
    [
        lambda model, _: dfsm.simulate(model, RUN),
        lambda model, _: dfsm.validate(model, [RUN]),
        lambda model, _: dfsm.validate({"mine": model}, [RUN]),
        lambda model, _: dfsm.calibrate(model, [RUN]),
        lambda model, _: dfsm.refine(model, [RUN]),
        lambda model, _: dfsm.steady_state(model),
        lambda model, _: dfsm.to_state_space(model),
        lambda model, _: dfsm.model_inputs(model, RUN),
        lambda model, _: dfsm.to_casadi(model),
        lambda model, place: dfsm.save(model, place / "model"),
        lambda model, place: dfsm.write_model_card(model, place / "card.html"),
    ],
)
@pytest.mark.parametrize("model", [None, "model/", object()])
def test_what_is_no_model_is_refused(
    model: Any, call: Callable[[Any, Path], object], tmp_path: Path
) -> None:
    with pytest.raises(dfsm.DfsmError, match=r"expected a model: dfsm\.load reads one"):
        call(model, tmp_path)
    assert not list(tmp_path.iterdir())
