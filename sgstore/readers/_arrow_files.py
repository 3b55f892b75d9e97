"""Arrow files (Feather) from untrusted sources, read batch by batch with the optional package pyarrow."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from itertools import repeat
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import MissingExtraError, TraceError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from sgstore.model.world import Floats

MAX_FILE: Final = 2 << 30
"""Maximum size of a file; bytes."""
_FAULTS: Final = (OSError, ValueError, TypeError, LookupError, MemoryError, NotImplementedError)
"""Exceptions of pyarrow. Its own exceptions are subclasses of these."""


def arrow() -> Any:
    """Return the module pyarrow.

    Raises
    ------
    MissingExtraError
        It is not installed.
    """
    try:
        return import_module("pyarrow")
    except ImportError as error:
        raise MissingExtraError("reading Arrow files (Argoverse 2, 123D)", "arrow") from error


def read_arrow_file(path: Path, columns: Iterable[str], lose: Callable[[str], None]) -> Any:
    """Return the given columns of an Arrow file as a table. Batches that are unreadable count as lost.

    Parameters
    ----------
    path : Path
    columns : iterable of str
        Names of columns; missing ones are left out of the result.
    lose : function
        Called with the reason of each loss.

    Raises
    ------
    TraceError
        The file does not exist, is too large, or is not an Arrow file.
    """
    pyarrow = arrow()
    import_module("pyarrow.ipc")
    try:
        if path.stat().st_size > MAX_FILE:
            raise TraceError(f"larger than {MAX_FILE:,} bytes", path=path)
        content = pyarrow.py_buffer(path.read_bytes())
    except (OSError, MemoryError) as error:
        raise TraceError(f"cannot be read: {_short(error)}", path=path) from error
    try:
        reader = pyarrow.ipc.open_file(content)
        schema, takes = (
            reader.schema,
            [partial(reader.get_batch, i) for i in range(reader.num_record_batches)],
        )
    except _FAULTS as error:
        # The end of the file lists its batches. Without it, they are read one after another.
        try:
            reader = pyarrow.ipc.open_stream(content.slice(8))
            schema, takes = reader.schema, repeat(reader.read_next_batch)
        except _FAULTS:
            reason = f"cannot be read as an Arrow file: {_short(error)}"
            raise TraceError(reason, path=path) from error
        lose(f"{path.name}: the end of the file is damaged")
    names = [name for name in columns if schema.get_field_index(name) >= 0]
    batches: list[Any] = []
    for number, take in enumerate(takes):
        try:
            batch = take().select(names)
            batch.validate(full=True)
            batches.append(batch)
        except StopIteration:
            break
        except _FAULTS as error:
            lose(f"{path.name}: batch {number} is damaged: {_short(error)}")
            if isinstance(takes, repeat):
                break
    fields = [(name, schema.field(name).type) for name in names]
    return pyarrow.Table.from_batches(batches, pyarrow.schema(fields, schema.metadata))


def numbers(table: Any, names: Iterable[str]) -> Floats:
    """Return columns of numbers as an array (rows, columns). Missing values are NaN.

    Raises
    ------
    TraceError
        A column is missing, or is not of numbers.
    """
    try:
        columns = [table.column(name).cast("float64").to_numpy() for name in names]
    except _FAULTS as error:
        raise TraceError(f"a column of numbers is missing: {_short(error)}") from error
    return np.stack(columns, axis=1) if columns else np.zeros((len(table), 0))


def values(table: Any, name: str) -> list[Any]:
    """Return a column as a list of Python values.

    Raises
    ------
    TraceError
        The column is missing, or contains invalid text.
    """
    try:
        return table.column(name).to_pylist()
    except _FAULTS as error:
        raise TraceError(f"a column is missing or damaged: {_short(error)}") from error


def _short(error: Exception) -> str:
    return str(error).partition("\n")[0][:150] or type(error).__name__
