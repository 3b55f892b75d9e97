"""The bar that long work shows, on a terminal and nowhere else."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from sgstore.ingest import Progress


@contextmanager
def ingest_bar() -> Generator[Callable[[Progress], None] | None]:
    """A function that shows the progress of an ingest on stderr; ``None`` where that is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[files]}{task.fields[frames]} frames"),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    task = bar.add_task("", total=None, files="", frames=0, speed="")

    def show(progress: Progress) -> None:
        elapsed = bar.tasks[task].elapsed or 0
        speed = f"{progress.all_bytes / elapsed / 1e6:.1f} MB/s" if elapsed > 0.5 else ""
        several = f"{progress.files_done}/{progress.files} files, " if progress.files > 1 else ""
        bar.update(
            task,
            description=progress.path.name,
            total=progress.all_size,
            completed=progress.all_bytes,
            files=several,
            frames=progress.all_frames,
            speed=speed,
        )

    with bar:
        yield show


@contextmanager
def count_bar(what: str, things: str) -> Generator[Callable[[int, int], None] | None]:
    """A function that shows how many of how many things are done; ``None`` where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TextColumn(things))
    with Progress(
        *columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
