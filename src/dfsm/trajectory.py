"""Runs and their channels, under the name that this module had before there were packages."""

from dfsm.data.trajectory import Channel, Trajectory

__all__ = ["Channel", "Trajectory"]
