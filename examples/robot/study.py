"""Co-design and the adaptive loop on robot arms whose true optimum is known.

First the mass of a link and the torques that lift it are optimized together on a surrogate, then
the torques that turn another arm, with every optimum simulated and learned from. Both are compared
with the optimum on the arm's own equations.

    python examples/robot/study.py [--seed 0]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import adaptive_robot  # its neighbours
import codesign
import dfsm


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both studies and print their results."""
    parser = argparse.ArgumentParser(description="Co-design and adaptive optimization of robots.")
    parser.add_argument("--seed", type=int, default=0, help="of the simulations and fits")
    seed = parser.parse_args(arguments).seed
    with dfsm.show_progress():
        arm = codesign.study(seed=seed)
    print(f"link mass and torques together, on a surrogate of {arm.training_runs} runs:")
    for name, solution in (("surrogate", arm.surrogate), ("truth", arm.truth)):
        print(f"  {name}: m2 = {solution.parameters['m2']:.4f} kg, cost {solution.objective:.5f}")
    print(f"  with the surrogate's mass the true arm costs {arm.loss:.3%} more than it must")
    for mass, cost in arm.split.items():
        print(f"  m2 = {mass:g} kg, only torques optimized: cost {cost:.5f}")
    with dfsm.show_progress():
        robot = adaptive_robot.study(seed=seed)
    print(f"least effort, adaptively, from {robot.training_runs} runs:")
    print(robot.result.summary())
    print(f"  truth: {robot.truth.objective:.6g}; the prediction is {robot.cost_error:.2%} off")


if __name__ == "__main__":
    main()
