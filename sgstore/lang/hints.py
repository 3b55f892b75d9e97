"""What would be right instead: hints for mistakes of people who know other languages, or other names."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.lang.catalog import NODE_ATTRIBUTES, Type
from sgstore.vocabulary import (
    KINDS,
    LANE_TYPES,
    LIGHT_STATES,
    SPECIALS,
    folded,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

MANY: Final = 24
"""So many names are listed in a hint."""

SYNONYMS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("velocity", "v", "vel", "kmh", "kph", "mph", "mps"), "speed"),
    **dict.fromkeys(("acc", "a", "deceleration", "decel"), "accel"),
    "acceleration": "accel",
    "yaw": "heading",
    "orientation": "heading",
    "rotation": "heading",
    "class": "kind",
    "category": "kind",
    **dict.fromkeys(("label", "labels", "object", "objecttype"), "kind"),
    "model": "type_name",
    **dict.fromkeys(("actorid", "trackid", "uuid"), "ident"),
    **dict.fromkeys(("indicator", "blinker", "turnsignal"), "light_left, light_right"),
    "brakelight": "light_brake",
    "state": "light_state",
    "limit": "speed_limit",
    "isego": "is_ego",
}
"""Other words, folded, for attributes of nodes."""

_PAIRS: Final = (
    *(
        "dist",
        "distance",
        "gap",
        "ttc",
        "headway",
        "bearing",
        "lon",
        "lat",
        "relspeed",
        "relheading",
    ),
    *("lanedist", "longap", "latgap", "closingspeed", "apparentheading"),
)

TOLD: Final[Mapping[str, str]] = {
    **dict.fromkeys(
        ("color", "colour", "make", "brand"), "what the simulator says of its type is in type_name"
    ),
    **dict.fromkeys(
        ("position", "location", "pose", "transform", "pos"),
        "the place of a node e is e.x, e.y, e.z",
    ),
    **dict.fromkeys(
        ("size", "extent", "dimensions", "bbox"), "its size is length, width and height"
    ),
    **dict.fromkeys(("t", "time", "seconds"), "the time since the trace began is frame.t"),
    "timestamp": "the time of a frame is frame.t or frame.time_ns",
    **dict.fromkeys(("frame", "frameid", "seq"), "the frame is frame.id, frame.seq or frame.t"),
    **dict.fromkeys(("trace", "traceid", "scenario", "recording"), "the trace is trace.name"),
    **dict.fromkeys(("map", "town"), "the map is trace.map"),
    **dict.fromkeys(("weather", "rain", "fog"), "the weather is env.precipitation, env.fog, …"),
    **dict.fromkeys(_PAIRS, "it is a number of two nodes, such as dist(ego, v)"),
    "jerk": "how much a value changes is delta(e.accel, 1s)",
}
"""What people ask for, folded, that is no attribute of nodes, and where it is to be found."""

OTHER_LABELS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("ego vehicle", "ego car", "hero", "self"), "Ego"),
    **dict.fromkeys(("automobile", "sedan", "suv", "pickup", "cab"), "Car"),
    **dict.fromkeys(("cyclist", "bike", "biker", "rider"), "Bicycle"),
    **dict.fromkeys(("lorry", "semi"), "Truck"),
    **dict.fromkeys(("motorbike", "scooter", "motorcyclist"), "Motorcycle"),
    **dict.fromkeys(("human", "people", "child", "adult"), "Person"),
    **dict.fromkeys(("agent", "actor", "object", "obstacle", "participant", "roaduser"), "Entity"),
    "street": "Road",
    **dict.fromkeys(("crossing", "zebra", "zebracrossing"), "Crosswalk"),
    **dict.fromkeys(("tree", "bush"), "Vegetation"),
    **dict.fromkeys(("trafficsign", "roadsign"), "Sign"),
    **dict.fromkeys(("cone", "trafficcone"), "Prop"),
}
"""Other words for labels."""

OTHER_RELATIONS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("close", "close to", "nearby", "next to"), "near"),
    **dict.fromkeys(("in front", "in front of", "ahead", "ahead of"), "inDFrontOf"),
    **dict.fromkeys(("behind", "rear", "rear of", "at rear of", "in rear of"), "atDRearOf"),
    **dict.fromkeys(("left", "left of"), "toLeftOf"),
    **dict.fromkeys(("right", "right of"), "toRightOf"),
    **dict.fromkeys(("on", "inside", "drives on", "located in"), "isIn"),
    **dict.fromkeys(("controls", "regulates"), "controlsTrafficOf"),
    **dict.fromkeys(("collision", "hits", "crashes", "collides with"), "collides"),
    **dict.fromkeys(("see", "can see"), "sees"),
    **dict.fromkeys(("lead", "leading", "leader of"), "leads"),
    "following": "follows",
}
"""Other words for relations."""

OTHER_FUNCTIONS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("time to collision", "tte"), "ttc"),
    **dict.fromkeys(("time headway", "time gap"), "headway"),
    **dict.fromkeys(("euclidean", "distance to", "euclidean distance"), "dist"),
    **dict.fromkeys(("angle", "angle to", "azimuth", "relative angle"), "bearing"),
    **dict.fromkeys(("in front of", "in front", "is ahead", "is in front"), "ahead"),
    **dict.fromkeys(("at rear", "is behind"), "behind"),
    **dict.fromkeys(("on left of", "is left of", "left"), "left_of"),
    **dict.fromkeys(("on right of", "is right of", "right"), "right_of"),
    **dict.fromkeys(("ceiling",), "ceil"),
    **dict.fromkeys(("ifnull", "nvl"), "coalesce"),
    **dict.fromkeys(("to lower", "lcase"), "lower"),
    **dict.fromkeys(("to upper", "ucase"), "upper"),
    **dict.fromkeys(("is known", "is not null"), "known"),
    **dict.fromkeys(("mean", "average"), "avg"),
    "lag": "prev",
}
"""Other words for functions."""

FUNCTIONS_TOLD: Final[Mapping[str, str]] = {
    **dict.fromkeys(("labels", "kind"), "what a node is: v.kind = 'car', or the label (v:Car)"),
    "id": "the id of a node v is v.id",
    **dict.fromkeys(("properties", "keys"), "attributes are named one by one: v.x, v.speed"),
    **dict.fromkeys(("size", "length", "len"), "matches are counted by COUNT {…}"),
    **dict.fromkeys(("any", "exists", "some"), "what holds of some node is EXISTS {… WHERE …}"),
    **dict.fromkeys(("all", "every"), "what holds of all nodes is NOT EXISTS {… WHERE NOT …}"),
    "none": "what holds of no node is NOT EXISTS {… WHERE …}",
    **dict.fromkeys(("pow", "power", "square"), "there are no powers: write x * x"),
    **dict.fromkeys(
        ("if", "iif", "case"), "there is no IF: ask for each case by itself, or return the value"
    ),
    **dict.fromkeys(
        ("collect", "list", "arrayagg"), "each match is a row; Matches.df() and SQL can group them"
    ),
    **dict.fromkeys(
        ("stddev", "stdev", "median", "percentile", "quantile", "variance"),
        "of a store: COUNT, MIN, MAX, AVG, SUM; others in SQL over the rows that a query gives",
    ),
    **dict.fromkeys(
        ("substring", "split", "replace", "trim", "concat"),
        "texts are asked by STARTS WITH, ENDS WITH, CONTAINS and =~",
    ),
    **dict.fromkeys(
        ("cast", "tointeger", "tofloat", "tostring"), "values have one type: leave it out"
    ),
    "clip": "write CLIPS(-3s, +5s)",
    **dict.fromkeys(
        ("f", "g", "x", "globally", "finally"),
        "operators of time are words: ALWAYS, EVENTUALLY, NEXT",
    ),
}
"""Functions of other languages, and what there is instead."""

METHODS: Final[Mapping[str, str]] = {
    "startswith": "write x.name STARTS WITH 'a'",
    "endswith": "write x.name ENDS WITH 'a'",
    **dict.fromkeys(("contains", "includes", "find"), "write x.name CONTAINS 'a'"),
    **dict.fromkeys(("match", "matches", "fullmatch"), "write x.name =~ 'a.*'"),
}
"""Methods of texts in other languages."""

LIKEN: Final[Mapping[str, str]] = {
    **dict.fromkeys(("police", "ambulance", "fire", "firetruck"), "emergency"),
    **dict.fromkeys(("cab", "uber"), "taxi"),
    "bus": "public_transport",
    "ev": "electric",
    **dict.fromkeys(("amber", "orange"), "yellow"),
}
"""Other words, folded, for words of the closed vocabularies."""

_OF_FRAMES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("time", "seconds"), "t"),
    **dict.fromkeys(("number", "index", "no", "sequence", "frame"), "seq"),
    "timestamp": "time_ns",
    **dict.fromkeys(("duration", "length", "lasts"), "frames"),
    **dict.fromkeys(("town", "road map"), "map"),
    "file": "uri",
    **dict.fromkeys(("rain", "snow", "weather"), "precipitation"),
    **dict.fromkeys(("light", "daylight", "night", "sun"), "illumination"),
    "hour": "time_of_day",
}
"""Other words for attributes of frames, traces and the weather."""

_WORDS: Final = frozenset(folded(w) for w in (*KINDS, *LIGHT_STATES, *SPECIALS, *LANE_TYPES))


_OTHERS: Final = tuple(
    {folded(word.replace(" ", "_")): meant for word, meant in words.items()}
    for words in (SYNONYMS, LIKEN, OTHER_LABELS, OTHER_RELATIONS, OTHER_FUNCTIONS, _OF_FRAMES)
)


def hint_at(name: str, known: Iterable[str]) -> str | None:
    """What a name may have meant: that which is most like it or short for it, or else all that is known.

    Names in an order keep it, so that what is common stands first; a set is sorted.
    """
    names = list(known) if isinstance(known, list | tuple) else sorted(known, key=str.lower)
    others = (words.get(folded(name)) for words in _OTHERS)
    other = next((word for word in others if word and word.split(", ")[0] in names), None)
    like = suggestion(name, names)
    if like and len(like) < 3 < len(name):  # two letters are like too much
        like = None
    like = other or like or _short_for(name, names)
    if like:
        return f"did you mean '{like}'?"
    more = f", … ({len(names)} in all)" if len(names) > MANY else ""
    return f"known: {', '.join(names[:MANY])}{more}" if names else None


def _short_for(name: str, names: list[str]) -> str | None:
    """A name that is the beginning of another one, and not by chance."""
    whole = folded(name)
    found = [n for n in names if len(n) >= 3 and whole.startswith(folded(n))]
    return max(found, key=len, default=None)


def bracket_hint(text: str, position: int, found: str) -> str | None:
    """Where a bracket that is not closed was opened, if the text ends too soon; or that there is none to close.

    Parameters
    ----------
    text : str
    position : int
        Where what was not expected begins.
    found : str
        What that is; empty at the end.
    """
    opened: list[int] = []
    for part in _BRACKETS.finditer(text, 0, position):
        if part[0] in _CLOSES:
            if opened and text[opened[-1]] == _CLOSES[part[0]]:
                opened.pop()
        elif len(part[0]) == 1:
            opened.append(part.start())
    if found in _CLOSES and _CLOSES[found] not in {text[place] for place in opened}:
        return f"there is no '{_CLOSES[found]}' that it closes"
    if found or not opened:
        return None
    after = text[opened[-1] + 1 :].strip()
    after = after if len(after) <= _EXCERPT else f"{after[:_EXCERPT].rstrip()}…"
    return f"the '{text[opened[-1]]}' before {after or 'the end'} is not closed"


_BRACKETS: Final = re.compile(
    r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|/\*(?:.|\n)*?\*/|[()\[\]{}]"""
)
"""Brackets, and what brackets may stand in that do not count."""

_CLOSES: Final = {")": "(", "]": "[", "}": "{"}
_EXCERPT: Final = 24


_SAID_OTHERWISE: Final = {
    **dict.fromkeys(
        ("nan", "none", "nil", "undefined", "missing"), "what is missing is asked by IS NULL"
    ),
    **dict.fromkeys(("yes", "no", "on"), "true and false are written TRUE and FALSE"),
    **dict.fromkeys(
        ("labels", "meta", "metadata", "splits", "outcomes", "annotations"),
        "a table of your own is joined by --with {name}=FILE",
    ),
    **dict.fromkeys(("interval", "runs"), "write INTERVALS"),
    **dict.fromkeys(("subgraph", "graph", "graphs"), "write SUBGRAPHS"),
    **dict.fromkeys(("clip", "clips"), "write CLIPS(-3s, +5s)"),
}
"""Words, folded, that stand for a value in other languages or are misspelt, and what is meant."""


def variable_hint(name: str, visible: Iterable[str], elsewhere: bool) -> str | None:  # noqa: FBT001
    """What a variable that is not known may have meant: an attribute, a text, the time; ``None``: no idea.

    Parameters
    ----------
    name : str
    visible : iterable of str
        Variables that may be used.
    elsewhere : bool
        Whether another part of the query binds one of that name.
    """
    if elsewhere:
        return "a variable of a block is known in this block only: bind it in MATCH"
    word = folded(name)
    if word in _SAID_OTHERWISE:
        return _SAID_OTHERWISE[word].format(name=name)
    if relation_named(name):
        return (
            f"a relation stands in a pattern, EXISTS {{(a)-[:{name}]->(b)}}, or is a text: '{name}'"
        )
    if word in TOLD:
        return TOLD[word]
    if word in NODE_ATTRIBUTES and len(word) > 1:
        owner = next(iter(sorted(set(visible) - {"ego"})), "ego")
        return f"an attribute stands behind a variable: {owner}.{NODE_ATTRIBUTES[word].name}"
    return f"a text stands in quotes: '{name}'" if word in _WORDS else None


def condition_hint(found: Type, written: str) -> str | None:
    """What would be right where a value stands for a condition.

    Parameters
    ----------
    found : Type
        Of the value.
    written : str
        It, as it is written.
    """
    if len(written) > _EXCERPT or found is Type.list:
        written = "…"
    if found is Type.number:
        return f"compare it: {written} > 0"
    if found is Type.text:
        return f"compare it: {written} = 'a'"
    if found is Type.node:
        return f"ask for something of it: {written}.speed > 3, stopped({written}), EXISTS {{…}}"
    return None


def comparison_hint(left: Type, right: Type, texts: Iterable[object]) -> str | None:
    """What would be right where values of two types are compared.

    Parameters
    ----------
    left, right : Type
    texts : iterable
        Texts that stand in the comparison as they are.
    """
    types = {left, right}
    if types == {Type.number, Type.text}:
        return next(filter(None, map(_number_hint, texts)), None)
    if Type.boolean in types:
        return "it is true or false: write it by itself, or after NOT"
    if types == {Type.node, Type.number}:
        return "the id of a node e is e.id"
    if types == {Type.node, Type.text}:
        return "the name of a node e is e.name, what it is e.kind"
    return None


def _number_hint(value: object) -> str | None:
    """What a text that stands for a number should be, or a number that stands for a text."""
    if isinstance(value, int | float):
        return f"a text stands in quotes: '{value}'"
    found = re.fullmatch(r"\s*([-+]?\d+(?:\.\d+)?)\s*([a-z°/²%]*)\s*", str(value), re.IGNORECASE)
    if found is None:
        return None
    if not found[2]:
        return f"a number has no quotes: {found[1]}"
    units = {"m/s": "speeds are in m/s", "km/h": "speeds are in m/s", "mph": "speeds are in m/s"}
    said = units.get(found[2].lower(), "m, m/s, degrees, s")
    return f"a number has no unit: {said}"
