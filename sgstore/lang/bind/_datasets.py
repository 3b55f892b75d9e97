"""Datasets in queries: traces selected by a name pattern or by a user table."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.catalog import Attribute, DisplayUnit, Home, Type
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.errors import TextSpan
    from sgstore.lang.bind._symbols import Session
    from sgstore.lang.catalog import TableFacts, TraceFacts

CLASSES_GIVEN: Final = "sgstore_classes"
"""Table with the frame classes of all stores of a collection. An empty ``dataset`` means all frames. Columns:
``dataset``, ``abstraction``, ``class``, ``frames``."""

CLASSES: Final = "datasetclasses"
"""Name (in lower case) of the function after ``IN``: ``frame.class IN dataset_classes('train')``."""


def traces_in(
    name: str,
    traces: Iterable[TraceFacts],
    tables: Mapping[str, TableFacts],
    *,
    part: bool = False,
) -> frozenset[int] | None:
    """Return the ids of the traces in a dataset. A dataset is a name pattern or a user table.

    ``None`` means an unknown dataset.

    Parameters
    ----------
    name : str
        A user table with one row for each trace, or a pattern of trace names with the wildcards ``*`` and
        ``?``.
    traces : iterable of TraceFacts
    tables : mapping of str to TableFacts
    part : bool
        True if other stores may contain the dataset.
    """
    if name in tables:
        return tables[name].traces
    found = frozenset(t.trace_id for t in traces if fnmatchcase(t.name, name))
    return found if found or part else None


def asked(name: str, span: TextSpan, session: Session) -> frozenset[int]:
    """Return the ids of the traces that a ``USING DATASET`` clause selects. An unknown name raises an error.

    Raises
    ------
    QueryError
        Unknown dataset, or a table of single frames.
    """
    found = traces_in(name, session.traces, session.tables, part=session.part)
    if found is None and name in session.tables:
        session.refuse(
            f"'{name}' is a table of frames; USING DATASET needs a table of traces",
            span,
            f"ask for its columns: WHERE {name}.… IS NOT NULL",
        )
    return _known(found, name, span, session)


def seen_in(
    classes: b.FrameAttribute, name: str, span: TextSpan, session: Session
) -> b.FrameAttribute:
    """Return a condition: true if the class of the frame's graph also occurs in a dataset.

    Raises
    ------
    QueryError
        Unknown dataset.
    """
    found = traces_in(name, session.traces, session.tables, part=session.part)
    table = session.tables.get(name)
    if found is None and table is not None and not table.joins:
        session.refuse(f"the rows of '{name}' do not refer to frames", span)
    if table is None:
        found = _known(found, name, span, session)
    (abstraction,) = classes.attribute.columns.values()
    attribute = Attribute(
        f"class_{abstraction} in {name}",
        Type.boolean,
        {Home.state: abstraction},
        "whether its class is in a dataset",
        DisplayUnit.seen,
        table=name if found is None else "",
        traces=tuple(sorted(found or ())),
        given=CLASSES_GIVEN if session.part else "",
    )
    return b.FrameAttribute(attribute, Type.boolean)


def class_count(abstraction: str, *, part: bool = False) -> b.FrameAttribute:
    """Return the frame attribute that counts the frames with the same graph class as this frame."""
    attribute = Attribute(
        f"class_count({abstraction})",
        Type.number,
        {Home.state: abstraction},
        "frames of its class",
        DisplayUnit.counted,
        given=CLASSES_GIVEN if part else "",
    )
    return b.FrameAttribute(attribute, Type.number)


def abstraction_named(name: str, span: TextSpan, session: Session) -> str:
    """Return the exact name of an abstraction. The store must have the frame classes of this abstraction.

    Raises
    ------
    QueryNameError
        Unknown abstraction.
    """
    found = next(
        (one for one in session.classed if normalize_name(one) == normalize_name(name)), None
    )
    if found is None:
        session.unknown("abstraction", name, span, session.classed)
    return found


def _known(
    found: frozenset[int] | None, name: str, span: TextSpan, session: Session
) -> frozenset[int]:
    if found is None:
        known = [*session.tables, *(trace.name for trace in session.traces)]
        session.unknown("dataset", name, span, known)
    return found
