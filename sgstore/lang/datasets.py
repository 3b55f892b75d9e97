"""Datasets in queries: traces whose names are alike, or a table of one's own that says which."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Final

from sgstore.lang import bound as b
from sgstore.lang.catalog import Attribute, Home, Type, Unit
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.errors import Span
    from sgstore.lang.catalog import TableFacts, TraceFacts
    from sgstore.lang.names import Session

CLASSES: Final = "datasetclasses"
"""The function after ``IN``, folded: ``frame.class IN dataset_classes('train')``."""


def traces_in(
    name: str, traces: Iterable[TraceFacts], tables: Mapping[str, TableFacts]
) -> frozenset[int] | None:
    """Ids of the traces of a dataset; ``None`` if nothing is called so.

    Parameters
    ----------
    name : str
        A table of one's own whose rows are of traces, or a name of traces, in which ``*`` and ``?`` stand for
        anything.
    traces : iterable of TraceFacts
    tables : mapping of str to TableFacts
    """
    if name in tables:
        return tables[name].traces
    return frozenset(t.trace_id for t in traces if fnmatchcase(t.name, name)) or None


def asked(name: str, span: Span, session: Session) -> frozenset[int]:
    """Ids of the traces that ``USING DATASET`` chooses.

    Raises
    ------
    QueryError
        There is no such dataset, or it is a table of single frames.
    """
    found = traces_in(name, session.traces, session.tables)
    if found is None and name in session.tables:
        session.refuse(
            f"'{name}' is a table of single frames, and USING DATASET chooses traces",
            span,
            f"ask for its columns: WHERE {name}.… IS NOT NULL",
        )
    return _known(found, name, span, session)


def seen_in(classes: b.FrameAttribute, name: str, span: Span, session: Session) -> b.FrameAttribute:
    """Whether the class of a frame is that of a frame of a dataset: traces, or a table with frames.

    Raises
    ------
    QueryError
        There is no such dataset.
    """
    found = traces_in(name, session.traces, session.tables)
    table = session.tables.get(name)
    if found is None and table is not None and not table.joins:
        session.refuse(f"the rows of '{name}' belong to no frames", span)
    if table is None:
        found = _known(found, name, span, session)
    (abstraction,) = classes.attribute.columns.values()
    attribute = Attribute(
        f"class_{abstraction} in {name}",
        Type.boolean,
        {Home.state: abstraction},
        "whether its class is in a dataset",
        Unit.seen,
        table=name if found is None else "",
        traces=tuple(sorted(found or ())),
    )
    return b.FrameAttribute(attribute, Type.boolean)


def class_count(abstraction: str) -> b.FrameAttribute:
    """How many frames of the store are of the class of the frame."""
    home = {Home.state: abstraction}
    name = f"class_count({abstraction})"
    attribute = Attribute(name, Type.number, home, "frames of its class", Unit.counted)
    return b.FrameAttribute(attribute, Type.number)


def abstraction_named(name: str, span: Span, session: Session) -> str:
    """The abstraction in which the store has the classes of frames, in its own spelling.

    Raises
    ------
    QueryNameError
        The store has none of that name.
    """
    found = next((one for one in session.classed if folded(one) == folded(name)), None)
    if found is None:
        session.unknown("abstraction", name, span, session.classed)
    return found


def _known(found: frozenset[int] | None, name: str, span: Span, session: Session) -> frozenset[int]:
    if found is None:
        known = [*session.tables, *(trace.name for trace in session.traces)]
        session.unknown("dataset", name, span, known)
    return found
