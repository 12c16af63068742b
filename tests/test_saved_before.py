"""A model and a solution that version 0.1 wrote: they load, and say what they said then."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file

from dfsm.control import DirectTranscription, OptimalControlProblem, solve
from dfsm.control.solution_folder import load_solution, save_solution
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning, hushed
from dfsm.models.dfsm import DFSM
from dfsm.models.model_folder import load, load_all, save
from dfsm.simulation.simulate import Status, simulate

FOLDER = Path(__file__).parent / "data" / "saved_by_0.1"
MODELS = ("multi-fidelity", "nonlinear-only")
UNITS = {"q": "m", "v": "m/s", "u": "N", "w": "m/s", "y": "kN", "z": "m"}


@pytest.fixture(scope="module")
def predictions() -> dict[str, np.ndarray]:
    """What version 0.1 computed with the models."""
    return load_file(FOLDER / "predictions.safetensors")


@pytest.fixture(scope="module")
def models() -> dict[str, DFSM]:
    return load_all(FOLDER / "model")


def same(values, expected: np.ndarray) -> None:
    """Equal but for a few units in the last place: another processor adds in another order."""
    np.testing.assert_allclose(values, expected, rtol=1e-13, atol=1e-14 * np.abs(expected).max())


# -- the model ----------------------------------------------------------------------------------


# The last bits are those of code as users compile it, which `make test` does not.
@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_it_predicts_what_it_did(models, predictions, name):
    at = models[name].split(predictions[f"{name}/inputs"])
    same(models[name].derivative(*at), predictions[f"{name}/derivative"])
    same(models[name].output(*at), predictions[f"{name}/output"])


def test_it_is_simulated_as_it_was(models, predictions):
    channels = tuple(Channel(*both) for both in UNITS.items())
    record = Trajectory(predictions["rollout/time"], predictions["rollout/record"], channels)
    # From the state it began in then: what comes before a record is taken otherwise today.
    initial = predictions["rollout/values"][0, :4]
    with hushed():
        rollout = simulate(models["multi-fidelity"], record, start=1.0, initial=initial)
    assert rollout.status is Status.COMPLETED
    assert rollout.trajectory.names == ("q", "q_dot", "latent1", "latent2", "y", "z")
    # Rounding grows along a rollout.
    np.testing.assert_allclose(
        rollout.trajectory.values, predictions["rollout/values"], rtol=1e-11, atol=1e-12
    )


def test_its_arrays_are_those_of_the_file(models):
    tensors = load_file(FOLDER / "model" / "model.safetensors")
    for name in MODELS:
        kept = {k: v for k, v in tensors.items() if k.startswith(f"{name}/")}
        leaves = {v.tobytes() for v in kept.values()}
        assert len(jax.tree.leaves(models[name])) == len(kept)
        assert {np.asarray(v).tobytes() for v in jax.tree.leaves(models[name])} == leaves


def test_its_structure_is_what_it_was(models):
    model, nonlinear = (models[name] for name in MODELS)
    assert (model.corrected, model.corrected_outputs) == ((1,), (0,))
    assert (type(model.e).__name__, type(model.e_g).__name__) == ("Perceptron", "GaussianUnits")
    assert model.schedule == "w"
    assert [c.name for c in model.signals.latents] == ["latent1", "latent2"]
    assert [c.name for c in nonlinear.signals.states] == ["q", "q_dot"]
    assert "rollouts teach a network the rest" in model.summary()


def test_it_is_written_as_it_was(models, tmp_path):
    model, nonlinear = (models[name] for name in MODELS)
    save(model, tmp_path / "once", nonlinear)
    again = load_all(tmp_path / "once")
    save(again["multi-fidelity"], tmp_path / "twice", again["nonlinear-only"])
    tensors = (FOLDER / "model" / "model.safetensors").read_bytes()
    for folder in ("once", "twice"):
        assert (tmp_path / folder / "model.safetensors").read_bytes() == tensors
    manifests = [(tmp_path / f / "manifest.json").read_bytes() for f in ("once", "twice")]
    assert manifests[0] == manifests[1]
    assert load(tmp_path / "twice").signals == model.signals


# -- the solution -------------------------------------------------------------------------------


def test_a_solution_is_what_it_was(tmp_path):
    tensors = load_file(FOLDER / "solution" / "solution.safetensors")
    solution = load_solution(FOLDER / "solution")
    assert solution.solved
    assert solution.objective == 0.015662164379125054
    assert solution.iterations == 28
    np.testing.assert_array_equal(solution.trajectory.time, tensors["trajectories/0/time"])
    np.testing.assert_array_equal(solution.trajectory.values, tensors["trajectories/0/values"])
    np.testing.assert_array_equal(solution.costates[0].values, tensors["costates/0/values"])
    assert solution.trajectory.names == ("q", "q_dot", "u", "w", "y", "z")
    save_solution(solution, tmp_path / "s")
    written = (tmp_path / "s" / "solution.safetensors").read_bytes()
    assert written == (FOLDER / "solution" / "solution.safetensors").read_bytes()


def test_a_solution_is_the_guess_of_another_solve(models):
    """Another model of the same plant is regulated to 0.2 m; one mesh, from either start."""
    before = load_solution(FOLDER / "solution")
    problem = OptimalControlProblem(
        model=models["nonlinear-only"],
        horizon=(1.0, 4.0),
        disturbances=before.trajectory.select(["w"]),
        cost=lambda s: (s.x.q - 0.2) ** 2 + 0.05 * s.u.u**2,
        bounds={"u": (-3.0, 3.0)},
        initial={"q": 0.4, "q_dot": 0.0},
    )
    method = DirectTranscription(mesh=30, refine=None)
    with pytest.warns(DfsmWarning, match="outside the training data .* u goes to"):
        near, cold = (solve(problem, method, guess, simulate=False) for guess in (before, None))
    assert near.solved
    assert near.objective == pytest.approx(cold.objective, rel=1e-7)
    assert near.iterations < cold.iterations
    # The cost above is the one of then: along the trajectory of then Simpson's rule gives it.
    t, (q, u) = before.trajectory.time, before.trajectory.select(["q", "u"]).values.T
    cost = (q - 0.2) ** 2 + 0.05 * u**2
    parts = np.diff(t[::2]) / 6 * (cost[:-2:2] + 4 * cost[1:-1:2] + cost[2::2])
    assert parts.sum() == pytest.approx(before.objective, rel=1e-12)
