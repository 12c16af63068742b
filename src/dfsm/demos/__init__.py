"""Studies that dfsm demo repeats."""
