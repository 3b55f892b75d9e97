"""Topics of recordings as columns: their fields, errors for unknown names, and values at given times.

A topic is a channel of a recording, such as ``/imu``. Its messages are rows, and its fields are columns:
``linear_acceleration.z``. An element of a list is a field, too: ``covariance[0]``.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import excerpt, excerpts
from sgstore.errors import SgstoreError
from sgstore.lang.catalog import TopicField
from sgstore.model.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.catalog import TopicFacts

    Ints = NDArray[np.int64]


RULES: Final = ("last", "nearest", "linear")
"""Rules for the value at a time: of the last message before it, of the nearest one, or interpolated."""

_INDEX: Final = re.compile(r"(?P<list>.+)\[(?P<index>\d{1,6})\]")


class TopicError(SgstoreError):
    """A topic, a field, or a rule does not exist, or the topic cannot be decoded.

    Parameters
    ----------
    reason, hint : str
        Fault, and remedy.
    """

    def __init__(self, reason: str, hint: str) -> None:
        super().__init__(f"{reason}; {hint}")
        self.reason, self.hint = reason, hint


def fields_of(facts: TopicFacts) -> Mapping[str, TopicField]:
    """Return the fields of a topic, by name.

    Raises
    ------
    TopicError
        The messages cannot be decoded.
    TraceError
        The recording of the topic is missing or unreadable.
    """
    if facts.refused:
        raise TopicError(f"topic {excerpt(facts.name)!r} cannot be decoded", facts.refused)
    return facts.source()


def topic_of(topics: Mapping[str, TopicFacts], name: str) -> TopicFacts:
    """Return the facts of a topic.

    Raises
    ------
    TopicError
        No topic has the name. The hint has the most similar name.
    """
    found = topics.get(name) or topics.get(f"/{name}")
    if found is None:
        raise unknown_topic(name, topics)
    return found


def unknown_topic(name: str, known: Iterable[str]) -> TopicError:
    """Return the error for a topic that does not exist, with the most similar topic or all topics."""
    names = sorted(known)
    like = suggestion(name, names)
    listed = f"the topics are {excerpts([*map(repr, names)])}" if names else "no topic has a name"
    return TopicError(f"no topic {excerpt(name)!r}", f"did you mean {like!r}?" if like else listed)


def field_of(facts: TopicFacts, path: str) -> TopicField:
    """Return a field of a topic, or an element of a list field: ``covariance[0]``.

    Raises
    ------
    TopicError
        The topic has no such field, or cannot be decoded. The hint has the most similar field.
    """
    fields = fields_of(facts)
    folded = {name.lower(): field for name, field in fields.items()}
    found = fields.get(path) or folded.get(path.lower())
    if found is not None:
        return found
    element = _INDEX.fullmatch(path)
    of = element and folded.get(element["list"].lower())
    if element and of and of.declared.endswith("[]"):
        return TopicField(f"{of.name}[{int(element['index'])}]", of.declared.removesuffix("[]"))
    hint = _like(path, fields)
    raise TopicError(f"topic {excerpt(facts.name)!r} has no field {excerpt(path)!r}", hint)


def _like(path: str, fields: Mapping[str, TopicField]) -> str:
    within = [name for name in fields if name.lower().startswith(f"{path.lower()}.")]
    if within:
        return f"it has {excerpts(within)}"
    like = suggestion(path, fields)
    ends = [name for name in fields if name.lower().endswith(f".{path.lower()}")]
    like = ends[0] if ends else like
    return f"did you mean {like!r}?" if like else f"its fields are {excerpts([*fields])}"


def values_at(
    stamps: Ints, values: NDArray[Any], times: Ints, rule: str, tolerance_ns: int | None
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the value of a topic's field at each of some times, and whether it is known.

    Parameters
    ----------
    stamps : (M,) int64
        Times of the messages, ascending; ns.
    values : (M,)
        Values of the field; ``None`` or NaN in object arrays means missing.
    times : (F,) int64
        ns.
    rule : str
        One of :data:`RULES`.
    tolerance_ns : int, optional
        Greatest distance in time to a message; ``None`` means unlimited.

    Notes
    -----
    Among messages of equal time, the last one counts. ``nearest`` prefers the earlier of two equally near
    messages.

    Examples
    --------
    >>> import numpy as np
    >>> stamps, values = np.array([0, 10]), np.array([1.0, 2.0])
    >>> values_at(stamps, values, np.array([4, 7]), "linear", None)[0].tolist()
    [1.4, 1.7]
    """
    limit = np.iinfo(np.int64).max if tolerance_ns is None else tolerance_ns
    last = np.append(stamps[1:] != stamps[:-1], True)[: len(stamps)]
    stamps, values = stamps[last], values[last]
    below = np.searchsorted(stamps, times, side="right") - 1
    above = np.searchsorted(stamps, times)
    if not len(stamps):
        return np.full(len(times), None, object), np.zeros(len(times), np.bool_)
    low, high = np.maximum(below, 0), np.minimum(above, len(stamps) - 1)
    before = np.where(below >= 0, times - stamps[low], np.iinfo(np.int64).max)
    after = np.where(above < len(stamps), stamps[high] - times, np.iinfo(np.int64).max)
    has_low, has_high = (below >= 0) & (before <= limit), (above < len(stamps)) & (after <= limit)
    if rule == "last":
        return values[low], has_low & _known(values[low])
    if rule == "nearest":
        later = has_high & (~has_low | (after < before))
        found = np.where(later, values[high], values[low])
        return found, (has_low | has_high) & _known(found)
    known = has_low & has_high & _known(values[low]) & _known(values[high])
    one, other = (np.where(known, values[row], 0).astype(np.float64) for row in (low, high))
    share = np.where(known & (before > 0), before, 0) / np.where(
        known, np.maximum(before + after, 1), 1
    )
    return one + (other - one) * share, known


def _known(values: NDArray[Any]) -> NDArray[np.bool_]:
    if values.dtype.kind != "O":
        return np.ones(len(values), np.bool_)
    return np.array([value is not None for value in values.tolist()], np.bool_)
