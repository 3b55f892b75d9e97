"""Names for queries (kinds, relations, attributes, functions) as texts for the prompt of an assistant."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from sgstore.base.display import first_of
from sgstore.lang.bind import FUNCTIONS
from sgstore.lang.catalog import (
    EDGE_ATTRIBUTES,
    ENV_ATTRIBUTES,
    FRAME_ATTRIBUTES,
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
)
from sgstore.lang.library import patterns
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.vocabulary import LABEL_ALIASES, LIGHT_STATES, SUPER_KINDS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Topic = Literal[
    "here", "language", "relations", "attributes", "functions", "predicates", "views", "topics"
]

TOPICS: Final[tuple[Topic, ...]] = get_args(Topic)

_SIGNATURE: Final = re.compile(r"PREDICATE\s+(\w+\s*\([^)]*\))")


def topic_text(about: Topic, known: Mapping[str, Any], word: str = "") -> str:
    """Return an explanation of a topic of the query language for an assistant.

    Parameters
    ----------
    about : Topic
        Any topic except ``language``, which is a page.
    known : mapping
        Facts about the store from the sandbox; see :mod:`sgstore.apps.assistant._worker`.
    word : str
        Only lines with this word. The name of a view selects this view with its columns.
    """
    if about == "views":
        return _views(known["views"], word)
    return with_word(_topic(about, known), word)


def with_word(text: str, word: str) -> str:
    """Return the lines of a text that contain a word, in any case."""
    return "\n".join(line for line in text.splitlines() if word.lower() in line.lower())


def _topic(about: Topic, known: Mapping[str, Any]) -> str:
    always = {"relations": _relations, "functions": _functions, "predicates": _predicates}
    here = {"attributes": _attributes, "topics": _topics}
    return always[about]() if about in always else here.get(about, _here)(known)


def _here(known: Mapping[str, Any]) -> str:
    kinds = ", ".join(f"{kind} ({number})" for kind, number in known["kinds"].items())
    several = "; ".join(
        f"{name}: {', '.join(of)}" for name, of in SUPER_KINDS.items() if name != "entity"
    )
    aliases = ", ".join(f"{word} = {kind}" for word, kind in LABEL_ALIASES.items())
    lines = [
        f"Kinds of entities here (how many): {kinds or 'none'}",
        f"Parts of the map: {', '.join(known['map_kinds']) or 'none'}",
        f"Labels for several kinds: {several}. Other words: {aliases}",
        "Relations here, source → destination:",
        *_ends(known["relations"]),
    ]
    lines += [f"Unknown of {trace}: {', '.join(of)}" for trace, of in known["unknown"].items()]
    lines += [f"Table {name}: {', '.join(columns)}" for name, columns in known["tables"].items()]
    if known["topics"]:
        named = first_of([f"{name} ({len(of)})" for name, of in known["topics"].items()], 30)
        lines.append(f"Recorded topics (number of fields; about='topics' lists them): {named}")
    return "\n".join(lines)


def _topics(known: Mapping[str, Any]) -> str:
    fields = (f"{name} {one}" for name, of in known["topics"].items() for one in of)
    return "\n".join(fields) or "no recorded topics"


def _ends(relations: Mapping[str, tuple[list[str], list[str]]]) -> list[str]:
    """Return lines of text: relations, with the kinds of their source and target nodes."""
    alike: dict[str, list[str]] = {}
    for name, (sources, targets) in relations.items():
        alike.setdefault(f"{', '.join(sources)} → {', '.join(targets)}", []).append(name)
    return [f"  {', '.join(names)}: {ends}" for ends, names in alike.items()]


def _relations() -> str:
    from sgstore.graphs.relations import relations

    found = (
        f"{one.name}: {one.doc}{' (needs a map)' if one.needs_map else ''}" for one in relations()
    )
    return "\n".join(found)


def _attributes(known: Mapping[str, Any]) -> str:
    own = [f"{name}: {kind}, of the recordings' own" for name, kind in known["own"].items()]
    return "\n".join(
        [
            "Of a node (x.NAME):",
            *_listed(NODE_ATTRIBUTES.values()),
            *own,
            "Of an edge (r.NAME):",
            *_listed(EDGE_ATTRIBUTES.values()),
            "Of the frame (frame.NAME):",
            *_listed(FRAME_ATTRIBUTES.values()),
            "Of the trace (trace.NAME):",
            *_listed(TRACE_ATTRIBUTES.values()),
            "Weather and light:",
            *_listed(ENV_ATTRIBUTES.values()),
        ]
    )


def _listed(attributes: Iterable[Attribute]) -> list[str]:
    return [f"  {one.name}: {one.meaning}{_values(one)}" for one in attributes]


def _values(attribute: Attribute) -> str:
    if attribute.enum == "kind":
        return ""
    values = LIGHT_STATES if attribute.enum == "light_state" else attribute.values
    return f" [{', '.join(values)}]" if values else ""


def _functions() -> str:
    numbers = [f"  {name}(a, b): {one.meaning}" for name, one in PAIR_FUNCTIONS.items()]
    others = sorted(FUNCTIONS - PAIR_FUNCTIONS.keys())
    topic = "A recorded topic at the frame: topic('/imu', nearest, 0.1s).angular_velocity.z"
    topic += " (rules: last, nearest, linear)"
    return "\n".join(["Of two entities:", *numbers, f"Others: {', '.join(others)}", topic])


def _predicates() -> str:
    lines: list[str] = []
    for one in patterns().values():
        if one.kind == "predicate":
            found = _SIGNATURE.search(one.query)
            lines.append(f"{found[1] if found else one.name}: {one.sentence}")
    return "\n".join(lines)


def _views(views: Mapping[str, Any], word: str) -> str:
    """Return a description of one view; or of each view that contains the word, its first sentence.

    Columns with the word follow the sentence.
    """
    if (view := views.get(word.lower())) is not None:
        return f"{word.lower()}({', '.join(view['columns'])}): {view['meaning']}"
    lines = [] if word else ["Columns of a view, with types and meanings: word='nodes'"]
    for name, view in views.items():
        line = f"{name}: {view['meaning'].partition('. ')[0].removesuffix('.')}"
        columns = [one for one in view["columns"] if word and word.lower() in one.lower()]
        if columns or word.lower() in line.lower():
            lines.append("; ".join([line, *columns]))
    return "\n".join(lines)
