"""Black boxes: simulators that turn initial states and inputs into trajectories."""

from dfsm.simulators.mass_chain import mass_chain
from dfsm.simulators.ode import ODESystem
from dfsm.simulators.two_link_robot import two_link_robot, two_link_robot_with_gravity

__all__ = ["ODESystem", "mass_chain", "two_link_robot", "two_link_robot_with_gravity"]
