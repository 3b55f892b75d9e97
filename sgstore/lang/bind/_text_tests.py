"""Binder of text comparisons: ``CONTAINS`` and similar words, and regular expressions."""

from __future__ import annotations

import re
import warnings
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.catalog import Type

if TYPE_CHECKING:
    from sgstore.errors import TextSpan
    from sgstore.lang.bind._symbols import SymbolTable
    from sgstore.lang.syntax import tree as s

_NOT_RE2: Final = re.compile(r"\(\?(?!:|P<\w+>|[ims]+[:)])|\\[1-9NuUZ]|[*+?}]\+")


def text_test(e: s.Comparison, left: b.Bound, right: b.Bound, names: SymbolTable) -> b.Operation:
    """Resolve a comparison of two texts, such as ``CONTAINS`` or ``=~``.

    Raises
    ------
    QueryError
        A side is not a text, or the text after ``=~`` is not a valid regular expression.
    """
    for side, written in ((left, e.left), (right, e.right)):
        if side.type is not Type.text:
            names.session.refuse(
                f"{e.word} compares texts, but this is a {side.type.value}", written.span
            )
    if e.word == "=~":
        _check_regex(right, e.right.span, names)
    return b.Operation(e.word, (left, right), Type.boolean)


def regex(text: str) -> re.Pattern[str]:
    """Compile a regular expression that Python and the database interpret in the same way.

    Raises
    ------
    re.error
        Invalid, or with a nested set, which they interpret differently: ``[[:alpha:]]``, ``[a&&b]``.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        try:
            return re.compile(text)
        except FutureWarning:
            raise re.error(
                "a set contains a set; write a backslash before [, -, &, | or ~ in a set"
            ) from None


def _check_regex(pattern: b.Bound, span: TextSpan, names: SymbolTable) -> None:
    if not isinstance(pattern, b.Value):
        names.session.refuse("the pattern after =~ must be a constant", span)
    text = str(pattern.value)
    try:
        regex(text)
    except re.error as error:
        names.session.refuse(f"not a regular expression: {error}", span)
    if _NOT_RE2.search(text):
        names.session.refuse(
            "this regular expression is not supported",
            span,
            "remove look-around and back-references",
        )
