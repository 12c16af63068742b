"""``python -m dfsm`` is the command ``dfsm``."""

from dfsm.cli import main

main()
