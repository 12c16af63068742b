"""Progress of long work: silent in scripts and pipes, a bar where the command line asks for it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress

T = TypeVar("T")
_active: ContextVar[Progress | None] = ContextVar("dfsm_progress", default=None)


@contextmanager
def show_progress(enabled: bool = True) -> Iterator[None]:
    """Draw progress bars on standard error while the block runs, if it is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not (enabled and console.is_terminal):
        yield
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        token = _active.set(progress)
        try:
            yield
        finally:
            _active.reset(token)


def track(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Iterate over `items`, moving a bar where `show_progress` is in force."""
    progress = _active.get()
    if progress is None:
        yield from items
        return
    total = len(items) if total is None and hasattr(items, "__len__") else total  # pyright: ignore[reportArgumentType]
    task = progress.add_task(description, total=total)
    try:
        for item in items:
            yield item
            progress.advance(task)
    finally:
        progress.remove_task(task)
