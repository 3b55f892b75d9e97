"""Hints for mistakes: syntax of other languages, and unknown names."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.lang._catalog import NODE_ATTRIBUTES, Type
from sgstore.vocabulary import (
    KINDS,
    LANE_TYPES,
    LIGHT_STATES,
    SPECIALS,
    normalize_name,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping


LOOK_BACK: Final = 400
"""So many characters before the unexpected part are looked at."""

EDGE_WRITTEN: Final = "an edge is written -[:near]->, or --> for any relation"
TIMES_WRITTEN: Final = "times are written 500ms, 2s, 1min or 10frames"
BRACES: Final = "a pattern stands in braces: EXISTS {(a)-[:near]->(b)}"


@dataclass(frozen=True, slots=True)
class SyntaxHint:
    r"""A mistake that is known by its look.

    Attributes
    ----------
    looks : re.Pattern
        What the text up to and with the unexpected part ends in.
    hint : str
        What would be right; ``\1`` stands for what the first group found.
    at : str
        One of :func:`places`: where only it is a mistake of this kind; empty: anywhere.
    then : re.Pattern
        What follows the unexpected part.
    """

    looks: re.Pattern[str]
    hint: str
    at: str
    then: re.Pattern[str]


def _slip(looks: str, hint: str, at: str = "", then: str = "") -> SyntaxHint:
    flags = re.IGNORECASE | re.DOTALL
    return SyntaxHint(re.compile(f"(?:{looks})$", flags), hint, at, re.compile(then, flags))


def places(names: Container[str]) -> frozenset[str]:
    """Return the kinds of a place in a text, by the terminals that may stand there.

    ``edge`` (or the end of a pattern), ``value`` (or a condition), ``operator`` (behind a value), ``time``
    (a length of it), ``number``, ``label``, ``name``, ``within`` an edge, ``start`` (of a statement), ``comma``
    where one may stand, ``node`` where its bracket may, ``part`` of a node.
    """
    value = "STRING" in names and "NULL" in names
    said = {
        "edge": "BARE_ANY" in names,
        "value": value,
        "operator": "SIGN" in names and "STAR" in names and not value,
        "time": "DURATION" in names and not value,
        "number": "NUMBER" in names and not value,
        "label": "PERCENT" in names and "NAME" in names,
        "name": "NAME" in names and not value,
        "within": "_CLOSE" in names,
        "start": "DEFINE" in names,
        "comma": "COMMA" in names,
        "part": "WHERE" in names and "RPAR" in names,
        "node": "LPAR" in names and not value and "SIGN" not in names,
    }
    return frozenset(place for place, so in said.items() if so)


_CLAUSES: Final = (
    _slip(r"\(\s*(WHERE|MATCH|RETURN)\s*:", r"\1 is a word of the language: choose another name"),
    _slip(r"\(\s*SELECT\s+\S+", "no query stands in a query: EXISTS {…}, COUNT {…}, MIN {… | x}"),
    _slip(r"\bFRAMES\.", "what is known of a frame is frame.id, frame.t, …"),
    _slip(r"^\s*WITH", "SQL is asked by sgstore sql, or store.sql()", then=r".*\bSELECT\b"),
    _slip(r"\b(?:SELECT|DESCRIBE|PRAGMA)|^\s*FROM", "SQL is asked by sgstore sql, or store.sql()"),
    _slip(r"\bOPTIONAL", "what may be absent is asked in a condition: EXISTS {…}, or COUNT {…}"),
    _slip(r"\bWITH", "there is no WITH: name conditions by DEFINE PREDICATE, results by AS"),
    _slip(
        r"\b(UNWIND|FOREACH)", r"there is no \1: a list stands behind IN, x.kind IN ['car', 'bus']"
    ),
    _slip(
        r"\b(?:CREATE|MERGE|DELETE|DETACH|SET|REMOVE|INSERT|UPDATE|DROP|ALTER)",
        "a query asks, and changes nothing",
    ),
    _slip(r"\b(?:CALL|YIELD)", "there are no procedures: functions stand in conditions and values"),
    _slip(
        r"\b(?:UNION|INTERSECT|EXCEPT)",
        "one query at a time: labels and relations are joined by |, conditions by OR",
    ),
    _slip(r"\bGROUP", "values beside COUNT, MIN, … are the groups: RETURN e.kind, AVG(e.speed)"),
    _slip(r"\bHAVING", "count in the pattern: WHERE COUNT {…} > 2"),
    _slip(
        r"\b(?:SKIP|OFFSET|TOP|FETCH)|\bLIMIT\s+\d+\s*,",
        "there is no such thing: LIMIT n gives the first ones",
    ),
    _slip(r"\bLIMIT\s+\S+\s+(?:ORDER|SAMPLE)", "the order is ORDER BY … SAMPLE … LIMIT …"),
    _slip(r"\bSORT", "write ORDER BY"),
    _slip(r"\b(ASC|DESC)ENDING", r"write \1"),
    _slip(r"\bNULLS", "NULL comes last, whatever the order"),
    _slip(r"\bSAMPLE\s+\d+\s+\w+", "write SAMPLE n PER value"),
    _slip(r"\b(LIMIT|SAMPLE)\s+\S*", r"a whole number stands after \1", at="number"),
    _slip(
        r"\b(?:any|all|none|single)\s*\([^()]*\bWHERE",
        "what holds of some node is EXISTS {… WHERE …}, of all NOT EXISTS {… WHERE NOT …}",
    ),
    _slip(r"\bRETURN\b.*\bWHERE", "WHERE stands before RETURN"),
    _slip(r"\bWHERE\b.*\bWHERE", "there is one WHERE: conditions are joined by AND"),
    _slip(
        r"^\s*USING\b.*\bUSING", "settings are separated by commas: USING NODES any, UNKNOWN false"
    ),
    _slip(r"\bUSING", "USING stands before MATCH"),
    _slip(r"\bUSING\s+\w+\s*[=:]", "a setting has no sign: USING NODES any"),
    _slip(r"\bUSING\b[^()]*\bMATCH\s*\(", "a setting has a value: USING NODES any"),
    _slip(r";\s*;", "a semicolon too many"),
    _slip(r";\s*(?:RETURN|WHERE|ORDER|LIMIT|THEN)", "a semicolon ends a query: leave it out"),
    _slip(r";\s*\(", "a semicolon ends a query: patterns are joined by commas"),
    _slip(r"^\s*(?:THEN|UNTIL|WHILE|HOLDS|FOR|NOT)", "a sequence begins with MATCH", at="start"),
    _slip(
        r"\b(?:ALWAYS|EVENTUALLY|FORALL|FORSOME|NEXT|ONCE|HISTORICALLY)",
        "a formula stands in a CHECK: CHECK name: ALWAYS …",
        at="start",
    ),
    _slip(r"^\s*(?:\(|RETURN|WHERE)", "a query begins with MATCH: MATCH (e:Ego)", at="start"),
    _slip(r"\bCHECK\s*:", "a name stands before the colon: CHECK calm: …"),
    _slip(r"\bCHECK\s+(\w+)\s+\w+", r"a colon stands behind the name: CHECK \1: …"),
    _slip(
        r"\bDEFINE\s+(?!PREDICATE\b|SCENARIO\b)\w+\s+\w+",
        "write DEFINE PREDICATE, or DEFINE SCENARIO",
    ),
    _slip(
        r"\bDEFINE\s+\w+\s+(\w+)\s+\w+",
        r"parameters stand in round brackets: DEFINE PREDICATE \1(a)",
    ),
    _slip(r"\bDEFINE\b[^;={]*\)\s*[={:]", "write AS before what it stands for"),
    _slip(r"\bDEFINE\b[^;]*\bMATCH", "a definition ends in a semicolon"),
)
"""Clauses of other languages, and clauses out of place."""

_STEPS: Final = (
    _slip(r"\bAND\s+THEN", "write THEN without AND"),
    _slip(
        r"\)\s*(?:AND|NEXT|FOLLOWED|AFTER|BEFORE|WITHIN|EVENTUALLY)",
        "what comes later stands behind THEN: THEN MATCH …, THEN WITHIN 4s MATCH …",
        at="edge",
        then=r"\s+(?:THEN\b|BY\b|MATCH\b|\d)",
    ),
    _slip(
        r"\bTHEN\s+(?:EVENTUALLY|NEXT|ALWAYS)",
        "THEN is any later frame; THEN WITHIN 4s, THEN AFTER 1s, THEN IMMEDIATELY say which",
    ),
    _slip(r"\bHOLDS\s+\S+", "a condition stands in brackets: HOLDS (e.speed > 3)"),
    _slip(r"\bIMMEDIATELY\s+\w+", "IMMEDIATELY is the next frame: it has no bound"),
    _slip(r"\bAFTER\s+\S+\s+BEFORE", "between 3 s and 4 s later is AFTER 3s WITHIN 4s"),
    _slip(r"\bTHEN\s*\S*", "behind THEN stands MATCH …, or HOLDS (condition)", then=r"(?!\s*\d)"),
    _slip(r"\bFOR\s+(\d+(?:\.\d+)?(?:ms|s|min|frames))", r"write FOR >= \1"),
    _slip(r"\bFOR\s+[^<>=\s]\S*", "write FOR >= 2s"),
    _slip(
        r"\bFOR\s*[<>=]+\s*\S+\s+(?:AND|OR)",
        "FOR stands behind the whole condition: WHERE … FOR >= 2s",
    ),
    _slip(
        r"\b(ALWAYS|EVENTUALLY|HISTORICALLY|ONCE|UNTIL|SINCE|RELEASE)\s*(?:\[[^\]]*\]?\s*\S*|\([^()]*,)",
        r"a bound has two ends, which are times: \1[0s, 5s]",
    ),
    _slip(
        r"\b(ALWAYS|EVENTUALLY|NEXT|WEAKNEXT|HISTORICALLY|ONCE|PREVIOUS)\s*\{",
        r"a pattern stands in EXISTS: \1 EXISTS {(a)-[:near]->(b)}",
    ),
    _slip(
        r"\bWITHIN",
        "a bound stands right behind the operator, EVENTUALLY WITHIN 5s …, or THEN WITHIN 5s",
        at="operator",
    ),
    _slip(
        r"\b(?:G|F|X|H|O|Y)\s+\w+|\s[URSW]",
        "operators of time are words: ALWAYS, EVENTUALLY, NEXT, UNTIL, …",
        at="operator",
    ),
)
"""What is written of time."""

_PATTERNS: Final = (
    _slip(r"\bMATCH\s+\w+\s*=", "a path has no name: name its nodes and edges"),
    _slip(
        r"\bMATCH\s+\w+\s*\(\s*\(",
        "there are no shortest paths: -[:near*1..3]-> is a way of 1 to 3 edges",
    ),
    _slip(r"\bMATCH\s+\w+\s*:", "a node stands in brackets: MATCH (e:Ego)"),
    _slip(
        r"\bMATCH\s+(\w+)\s*", r"a node is written (\1), a pattern of the library \1()", at="node"
    ),
    _slip(
        r"\bMATCH\s+(\w+)\s*\([^()=]*\)?",
        r"parameters are written \1(name = value), and conditions stand behind WHERE",
    ),
    _slip(r"\)\s*-\(", "an edge is written -[:near]-> or -->"),
    _slip(
        r"\)\s*<?--+>?",
        "a node stands in round brackets: (v); before a comment, -- …, stands a blank",
        at="edge",
        then=r"\s*\w",
    ),
    _slip(r"\)\s*(?:=|->?|<|<?--+>?)", EDGE_WRITTEN, at="edge"),
    _slip(r"\)\s*MATCH", "separate patterns by commas"),
    _slip(
        r"\)\s*(?:,\s*)?NOT",
        "what must not be there is asked in a condition: WHERE NOT EXISTS {…}",
        then=r"\s*(?:MATCH\b|EXISTS\b|\()",
    ),
    _slip(
        r"\)\s*(?:\(|AND|&&?)",
        "patterns are joined by commas, and conditions stand behind WHERE",
        at="edge",
    ),
    _slip(r"(?:\bMATCH|,|[->]|\{)\s*[\[{]", "a node stands in round brackets: (e:Ego)", at="node"),
    _slip(
        r"\b(MIN|MAX|AVG|SUM)\s*\{[^{}|]*(?:\}|,\s*\w+)",
        r"the value stands behind |: \1 {(a)-[:near]->(b) | b.speed}",
    ),
    _slip(r"(?:,|[->])\s*([A-Za-z_]\w*)", r"a node stands in round brackets: (\1)", at="node"),
    _slip(r"\(\s*(\w+)\s+IS", r"a label stands behind a colon: (\1:Car)", at="part"),
    _slip(
        r"\(\s*\w*\s*(?::[^(),]*)?(?:\.|(?<=\w)\s+\w+(?<!\bOR)|[<>=])",
        "a condition stands behind WHERE: (x:Car WHERE x.speed > 3)",
        at="part",
        then=r"\s*(?:[<>=.]|\w+\s*[<>=]|-?\d)",
    ),
    _slip(r"\(\s*(\w+)\s+(\w+)", r"a label stands behind a colon: (\1:\2)", "part", r"\s*\)"),
    _slip(r"\(\s*\w*\s*:[^(),]*,", "each node has brackets of its own: (a), (b)", at="part"),
    _slip(r"\bMATCH\s*<?-", "a path begins with a node: ()-[:near]->(b)"),
    _slip(r"(?:\]-|>|--|<--)\s*", "an edge leads to a node: (b), or () for any", "node", r"\Z"),
    _slip(r"\[\s*\w*\s*:[^\]]*\|\s*:", "one colon is enough: -[:near|visible]->"),
    _slip(r"\(\s*\w*\s*:[^)]*:", "labels are joined by & or |: (v:Car&Ego)"),
    _slip(r"[|&]\s*\]", "a relation is missing before the bracket"),
    _slip(r":\s*\]", "the relation stands behind the colon: -[:near]->"),
    _slip(r"\[[^\]*]*(?:,|\bOR|/)", "relations are joined by |: -[:near|visible]->", at="within"),
    _slip(r"\*\s*\d*(?:\.\.\d*)?\s*[-,.]", "an edge is repeated by *1..3"),
    _slip(r"\{\s*\d+(?:\.\.?|-|:)?|\{\s*\d+\s*\.", "an edge is repeated by *1..3"),
    _slip(r"\]", "an edge is repeated in its brackets: -[:near*1..3]->", "within", r"\s*\{"),
    _slip(r"\[\s*\w*\s*:\s*\w+\s+\w+", "a relation is one word, such as very_near", at="within"),
    _slip(r"\+", "an edge is repeated by *1..3", at="within"),
    _slip(r"\]-?>?\s*[+*]", "an edge is repeated in its brackets: -[:near*1..3]->"),
    _slip(r"\]\s*>", "an edge ends in ]->"),
    _slip(r"\]-\s*-?>?|\[[^\]]*[\]-]", "an edge ends in ]-> or ]-"),
    _slip(r"\w\s*:\s*[<>]=?|\{\s*\w+\s*[<>]=?", "a property is a value; write WHERE x.speed > 5"),
    _slip(r"[{,]\s*\w+\s*=|\{\s*\w+\s+\w+", "a property is written name: value, {speed: 3}"),
    _slip(r"\{[^{}]*;", "properties are separated by commas"),
    _slip(r"\(\s*\w*(?:\s*:[^()]*)?\{\s*\}", "no braces where there is no property"),
    _slip(r"\bEXISTS\s*\{\s*\S*", BRACES),
    _slip(r"\{[^{}]*\bRETURN", "a block returns nothing: leave RETURN out"),
)
"""Nodes, edges and blocks."""

_CONDITIONS: Final = (
    _slip(
        r"\bEXISTS\s*\(",
        "whether an attribute is known: x.speed IS NOT NULL",
        "",
        r"\s*\w+\.\w+\s*\)",
    ),
    _slip(r"EXISTS\s*\(", "write EXISTS {(a)-[:near]->(b)}, in braces"),
    _slip(r"\bEXISTS\s+\w+", BRACES),
    _slip(r"\bFORALL\s*\(.*:", "FORALL belongs to CHECK; here: NOT EXISTS {(v:Car) WHERE NOT …}"),
    _slip(r"[)\w]\s*<?-\[\s*\w*:", f"in a condition, {BRACES}"),
    _slip(r"-\s*->?", f"in a condition, {BRACES}", at="value"),
    _slip(r"\bCOUNT\s*\(\s*\(.*:", "a pattern is counted in braces: COUNT {(v:Car)}"),
    _slip(r"\bCOUNT\s*\{[^{}]*\|", "COUNT takes no value, SUM {(a)-->(b) | b.speed} does"),
    _slip(
        r"\bCOUNT\s*\(\s*(?:\)|DISTINCT\s*\*)",
        "all matches are COUNT(*), different values COUNT(DISTINCT x.id)",
    ),
    _slip(r"\bCOUNT\s*\([^()]*,", "COUNT takes one value"),
    _slip(r"==", "equality is written '='"),
    _slip(r"<=\s*=|>=\s*=", "one sign too many: <= or >="),
    _slip(r"=\s*<", "at most is written <="),
    _slip(r"&&?", "write AND", at="operator"),
    _slip(r"\|\|?", "write OR", at="operator"),
    _slip(r"!", "write NOT before a condition", at="value"),
    _slip(r"\bIS\s+(NOT\s+)?(?:NONE|NIL|UNDEFINED|NAN|MISSING|UNKNOWN)", r"write IS \1NULL"),
    _slip(r"\bIS\s+NOT\s+\S+", "inequality is written '<>'"),
    _slip(r"\bIS\s+\S+", "equality is written '='"),
    _slip(r"\bISNULL", "write IS NULL"),
    _slip(r"\b(?:NOT\s+NULL|NOTNULL)", "write IS NOT NULL"),
    _slip(
        r"\bNOT\s+(?:CONTAINS|STARTS|ENDS|BETWEEN|=)",
        "NOT stands before the whole: NOT x.name CONTAINS 'a'",
    ),
    _slip(r"\b(STARTS|ENDS)_?WITH", r"write \1 WITH", at="operator"),
    _slip(r"\b(STARTS|ENDS)\s+\S+", r"write \1 WITH"),
    _slip(r"\bBETWEEN", "write x >= 3 AND x <= 5"),
    _slip(r"\bI?LIKE", "write STARTS WITH, ENDS WITH, CONTAINS, or =~ with a regular expression"),
    _slip(r"=~\s*/", "a regular expression is a text in quotes: =~ 'car.*'"),
    _slip(r"\bIN\s*\([^()]*,|\bIN\s*\{", "a list stands in square brackets: IN [1, 2]"),
    _slip(r"\bIN\s+(?:'[^']*'|[\w.]+)\s*,", "a list stands in square brackets: IN [1, 2]"),
    _slip(r"[<>]=?\s*[\w.]+\s*[<>]=?", "write 3 < x.speed AND x.speed < 5"),
    _slip(r"\bCASE\s+\w+|\?", "there is no CASE: ask for each case by itself, or return the value"),
    _slip(r"\b(?:AND|OR|XOR)\s+(?:AND|OR|XOR)\s+\S+", "one of AND, OR and XOR at a time"),
    _slip(r"//", "a quotient is written x / y, a comment -- to the end of the line", at="value"),
    _slip(r"/\*", "the comment has no end", at="value"),
    _slip(r"/", "the comment has no end", then=r"\*"),
    _slip(r"#|/", "a comment is written -- to the end of the line, or /* in between */"),
    _slip(r"\*\*|\^", "there are no powers: write x * x"),
    _slip(r"\w\[", "an attribute stands behind a dot: x.speed", at="operator"),
    _slip(r"\.(?!class\b)(\w+)\s*\(\s*\S*", r"what is called stands first: \1(a, b)"),
    _slip(r"\w:", "a label stands in a pattern, (v:Car); or write v.kind = 'car'", at="operator"),
)
"""Conditions."""

_VALUES: Final = (
    _slip(r"\d,", "a number has no commas", then=r"\d{3}\b"),
    _slip(r"(?<!\w)\d+_\w*", "a number has no underscores"),
    _slip(r"(?<!\w)0[xob]\w+", "numbers are decimal"),
    _slip(r"\d\s*mph", "speeds are in m/s: write 30 * 0.447"),
    _slip(r"\d\s*(?:kmh|kph|km)", "speeds are in m/s: write 30 / 3.6"),
    _slip(
        r"\d\s*(?:m|cm|met(?:er|re)s?|ft|feet)",
        "a number has no unit: lengths are in m, speeds in m/s",
    ),
    _slip(r"\d\s*(?:deg|degrees?|rad|°)", "a number has no unit: angles are in degrees"),
    _slip(r"\d\s*h|\d\s+(?:s|ms|frames?|min)|\d\s*sec\w*|\d\s*min\w+", TIMES_WRITTEN),
    _slip(r"[\[,(]\s*\d+\.\.?", "a list names all that is in it: [1, 2, 3]"),
    _slip(r"\d\.\s*\w*", "behind the point of a number stands a digit: 5.0", at="name"),
    _slip(r"(?<![\w.])\.", "before the point of a number stands a digit: 0.5", at="value"),
    _slip(r"\w\.\.", "one dot too many"),
    _slip(r"\b(\w+)\.\*", r"the attributes are named one by one: \1.x, \1.speed"),
    _slip(r"\bCLIPS\s*(?:\([^)]*\)?)?", "write CLIPS(-3s, +5s)"),
    _slip(
        r"\bDISTINCT\s+\S+",
        "DISTINCT stands right behind RETURN, or in COUNT(DISTINCT x)",
        at="operator",
    ),
    _slip(r"(?:\bRETURN|,)\s*(?:\([^()]*,|\{)", "values are listed without brackets: RETURN e, v"),
    _slip(r",\s*,", "a comma too many"),
    _slip(r"\S.*?,\s*", "nothing stands behind the comma", then=r"\Z"),
    _slip(r"\bWHERE\b(?:(?!\bRETURN\b).)*,", "conditions are joined by AND"),
)
"""Numbers, units, and what stands after ``RETURN``."""

_LAST: Final = (
    _slip(r"", TIMES_WRITTEN, at="time"),
    _slip(r"^\s*\S+", "a query begins with MATCH: MATCH (e:Ego)", at="start"),
    _slip(r";\s*\S+", "a semicolon ends a query", at="start"),
)
"""What is said if nothing else can be."""

_PREFIXES: Final = (
    "NOT",
    "EXISTS",
    "COUNT",
    "ALWAYS",
    "EVENTUALLY",
    "NEXT",
    "HISTORICALLY",
    "ONCE",
)

_ODD: Final = {
    **dict.fromkeys("→⇒⟶", "->"),
    **dict.fromkeys("←⇐⟵", "<-"),
    **dict.fromkeys("–—−‐", "-"),  # noqa: RUF001 - what is meant
    **dict.fromkeys("‘’‚´", "'"),  # noqa: RUF001
    **dict.fromkeys("“”„«»", '"'),
    **dict(zip("≥≤≠∈∧∨¬", (">=", "<=", "<>", "IN", "AND", "OR", "NOT"), strict=True)),  # noqa: RUF001
    **dict(zip("×÷∞…", ("*", "/", "INF", ".."), strict=True)),  # noqa: RUF001
}
"""Characters that look like a sign of the language, and the sign."""


def slip_hint(
    text: str, start: int, end: int, at: frozenset[str], words: Iterable[str]
) -> str | None:
    """Return a hint for an unexpected part of a text; ``None``: no idea.

    Parameters
    ----------
    text : str
    start, end : int
        The part.
    at : frozenset of str
        What kind of place it is: :func:`places`.
    words : iterable of str
        Keywords that may stand there.
    """
    found = text[start:end]
    if hint := _character(found, at):
        return hint
    before = text[max(start - LOOK_BACK, 0) : end]
    for slips in (_CLAUSES, _STEPS, _CONDITIONS, _PATTERNS, _VALUES):
        if hint := _looked(slips, before, text, end, at):
            return hint
    if like := _like(found, words):
        return f"did you mean {like}?"
    if "operator" in at and re.match(r"[\w$'\"]", found):
        return _joined(found, before[: len(before) - len(found)], at)
    return _looked(_LAST, before, text, end, at)


def _looked(
    slips: tuple[SyntaxHint, ...], before: str, text: str, end: int, at: frozenset[str]
) -> str | None:
    for slip in slips:
        if slip.at and slip.at not in at:
            continue
        found = slip.looks.search(before)
        if found and slip.then.match(text, end, end + LOOK_BACK):
            return found.expand(slip.hint)
    return None


def _character(found: str, at: frozenset[str]) -> str | None:
    """A hint for a character that no text of the language has, or has elsewhere only."""
    if found in {"'", '"'}:
        return "the text in quotes has no end"
    if found[:1] in {"'", '"'}:
        what = "a label" if "label" in at else "a name" if "name" in at else ""
        word = found[1:-1]
        return f"{what} stands without quotes: {word}" if what and word.isidentifier() else None
    if found == "`":
        return "a name stands without quotes, a text in '…'"
    if found in _ODD:
        return f"write {_ODD[found]} instead of {found}"
    return _unknown_letter(found, at)


def _unknown_letter(found: str, at: frozenset[str]) -> str | None:
    if found[:1].isalpha() and not found[0].isascii() and "name" in at:
        return "a name begins with one of a to z, or _"
    if found and unicodedata.category(found[0]).startswith("C"):
        return "it cannot be seen: delete it"
    return None


def _like(word: str, keywords: Iterable[str]) -> str | None:
    """The keyword that a word was meant to be, if it begins as that does."""
    like = (
        suggestion(word.upper(), [w for w in keywords if w.isalpha()]) if word.isalpha() else None
    )
    return like if like and like != word.upper() and like[0] == word[0].upper() else None


def _joined(found: str, before: str, at: frozenset[str]) -> str | None:
    """A hint for a word that stands behind a value: what is misspelt before it, or missing in between."""
    last = re.search(r"(\w+)\s*$", before)
    if last and (like := _like(last[1], _PREFIXES)):
        return f"did you mean {like}?"
    if relation_named(found):
        return f"a relation stands in a pattern: EXISTS {{(a)-[:{found}]->(b)}}"
    if "comma" in at:
        return "values are separated by commas"
    return "conditions are joined by AND, and texts stand in quotes"


# What would be right instead: hints for mistakes of people who know other languages, or other names ----

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
    *("lanedist", "longap", "latgap", "closingspeed", "closingtime", "apparentheading"),
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

_WORDS: Final = frozenset(
    normalize_name(w) for w in (*KINDS, *LIGHT_STATES, *SPECIALS, *LANE_TYPES)
)


_OTHERS: Final = tuple(
    {normalize_name(word.replace(" ", "_")): meant for word, meant in words.items()}
    for words in (SYNONYMS, LIKEN, OTHER_LABELS, OTHER_RELATIONS, OTHER_FUNCTIONS, _OF_FRAMES)
)


def hint_at(name: str, known: Iterable[str]) -> str | None:
    """Return a hint for an unknown name: the most similar one, or else all that are known.

    Names in an order keep it, so that what is common stands first; a set is sorted.
    """
    names = list(known) if isinstance(known, list | tuple) else sorted(known, key=str.lower)
    others = (words.get(normalize_name(name)) for words in _OTHERS)
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
    whole = normalize_name(name)
    found = [n for n in names if len(n) >= 3 and whole.startswith(normalize_name(n))]
    return max(found, key=len, default=None)


def bracket_hint(text: str, position: int, found: str) -> str | None:
    """Return a hint for an unmatched bracket: where it was opened, or that there is none to close.

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
    """Return a hint for an unknown variable: an attribute, a text, the time; ``None``: no idea.

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
    word = normalize_name(name)
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
    """Return a hint for a value that stands in place of a condition.

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
    """Return a hint for a comparison of values of two types.

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
    """Return a hint for a text in place of a number, or a number in place of a text."""
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
