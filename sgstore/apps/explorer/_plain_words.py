"""Plain words for coverage tables, in place of the names of labels, relations and statistics."""

from __future__ import annotations

import re
from typing import Final

RELATION_WORDS: Final = {
    "isIn": "in",
    "toLeftOf": "left of",
    "toRightOf": "right of",
    "safety_hazard": "at a hazardous distance from",
    "near_coll": "at near-collision distance from",
    "super_near": "extremely near",
    "very_near": "very near",
    "near": "near",
    "visible": "within sight distance of",
    "inDFrontOf": "directly ahead of",
    "inSFrontOf": "ahead and to the side of",
    "atSRearOf": "behind and to the side of",
    "atDRearOf": "directly behind",
}
"""Words for the relations of the abstractions. Other relations keep their names, as separate words."""

_LABELS: Final = {
    "ego": "the ego",
    "Ego Lane": "the lane of the ego",
    "Lane": "an unknown lane",
    "Root Road": "the road",
    "Off Road": "the area beside the road",
}
_BESIDE: Final = re.compile(r"(Left|Right) (\d+) of Ego Lane")
_CAPITAL: Final = re.compile(r"(?<=[a-z])(?=[A-Z])")
_CLASSES: Final = (
    (re.compile(r"\bclasses\b"), "kinds of scenes"),
    (re.compile(r"\bclass\b"), "kind of scene"),
)


def label_words(label: str) -> str:
    """Return a label of an abstraction in words.

    Examples
    --------
    >>> [label_words(one) for one in ("traffic_light", "Left 1 of Ego Lane", "Opposing Lane 0")]
    ['traffic light', 'lane 1 to the left of the ego', 'other lane 1']
    """
    if beside := _BESIDE.fullmatch(label):
        return f"lane {beside[2]} to the {beside[1].lower()} of the ego"
    if label.startswith("Opposing Lane "):
        return f"other lane {int(label.rpartition(' ')[2]) + 1}"
    return _LABELS.get(label) or label.replace("_", " ")


def relation_words(relation: str) -> str:
    """Return a relation in words, such as ``directly ahead of``."""
    spaced = _CAPITAL.sub(" ", relation).replace("_", " ").lower()
    return RELATION_WORDS.get(relation, spaced)


def feature_words(text: str, relations: frozenset[str]) -> str:
    """Return one feature, or several joined with ``&``, in words.

    Parameters
    ----------
    text : str
        Labels of source, edge and destination of each feature, or the label of a node.
    relations : frozenset of str
        Names of all relations.

    Examples
    --------
    >>> feature_words("car inDFrontOf ego & ego isIn Ego Lane", frozenset({"isIn", "inDFrontOf"}))
    'car directly ahead of the ego, with the ego in the lane of the ego'
    """
    return ", with ".join(_one_feature(one, relations) for one in text.split(" & "))


def _one_feature(text: str, relations: frozenset[str]) -> str:
    words = text.split(" ")
    at = next((i for i, word in enumerate(words) if i and word in relations), None)
    if at is None:
        return label_words(text)
    ends = " ".join(words[:at]), " ".join(words[at + 1 :])
    return f"{label_words(ends[0])} {relation_words(words[at])} {label_words(ends[1])}"


def plain_sentence(text: str) -> str:
    """Return a sentence in which ``kind of scene`` replaces the term ``class``."""
    for word, plain in _CLASSES:
        text = word.sub(plain, text)
    return text
