"""Numbers of a pair of entities (a, b): each declared once, for the view ``pairs``, the language and arrays.

A number is an expression of SQL over others of the same pair, down to the columns of both entities (``a_x``: x
of a; conventions of axes and units in :mod:`sgstore.geometry`). The view and the compiler write it into
statements, layer by layer, because DuckDB shares named columns and not repeated expressions;
:class:`PairNumbers` computes the same expression with arrays, where NaN is NULL. What a number needs of an
entity follows from its columns.

One more number is one more entry of :data:`PAIR_FUNCTIONS`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from functools import cache, reduce
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from sgstore.arrays import np
from sgstore.records import dataclass

if TYPE_CHECKING:
    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"


@dataclass(frozen=True, slots=True)
class PairFunction:
    """Declaration of a number of two entities a and b.

    Attributes
    ----------
    doc : str
        Meaning, in terms of a and b.
    unit : str
    sql : str
        Expression over columns of both entities, parts (:data:`_PARTS`) and other numbers; empty: it is looked
        up elsewhere, and is no column of the view.
    note : str
        Special values.
    column : str
        Name in the view ``pairs``, where it differs.
    alias : str
        Second name in the language.
    dear : bool
        Whether a condition on it is tested after those on the others, and a bound on the distance before.
    """

    doc: str
    unit: str
    sql: str
    note: str = ""
    column: str = ""
    alias: str = ""
    dear: bool = False

    @property
    def meaning(self) -> str:
        """The documentation in one line."""
        return f"{self.doc}; {self.unit}" + (f"; {self.note}" if self.note else "")


def _turned(angle: str) -> str:
    """An angle in degrees, brought into (-180, 180]."""
    return f"{angle} - 360 * ceil(({angle} - 180) / 360)"


LANE_DIST: Final = "lane_dist"
"""The number that is no expression: it is looked up, by lanes and ways between them."""

PAIR_FUNCTIONS: Final[Mapping[str, PairFunction]] = {
    "dist": PairFunction(
        "distance between the centres, in space",
        "m",
        "sqrt(dx * dx + dy * dy + dz * dz)",
        column="distance",
    ),
    # The distance of b's centre from the Minkowski sum of both boxes, an octagon around a's centre whose edges
    # are those of both. Boxes are symmetric about their centres: of two opposite edges only the one on the side
    # of b's centre can be the nearest, so four remain, two in a's axes and two in b's.
    "gap": PairFunction(
        "shortest distance between the footprints",
        "m",
        "CASE WHEN reach1 + reach2 IS NULL THEN NULL WHEN greatest(out1, out2, out3, out4) <= 0 THEN 0"
        " ELSE sqrt(least("
        + ", ".join(
            f"CASE WHEN out{i} > 0 THEN out{i} * out{i} + greatest(past{i}, 0) * greatest(past{i}, 0) END"
            for i in (1, 2, 3, 4)
        )
        + ")) END",
        note="0 where they touch or overlap",
        dear=True,
    ),
    "bearing": PairFunction(
        "direction of b's centre in a's axes, positive to the left", "degrees", _turned("course")
    ),
    "rel_heading": PairFunction("b's heading less a's", "degrees", _turned("turned")),
    "lon": PairFunction(
        "how far b's centre lies ahead of a's, in a's axes", "m", "dx * ca + dy * sa"
    ),
    "lat": PairFunction(
        "how far b's centre lies to the left of a's, in a's axes", "m", "dy * ca - dx * sa"
    ),
    "closing_speed": PairFunction(
        "how fast the centres approach one another",
        "m/s",
        "-(dx * dvx + dy * dvy) / nullif(planar, 0)",
    ),
    # Two boxes meet where their shadows meet on each axis of both (separating axes: Gottschalk, Lin and
    # Manocha, OBBTree, SIGGRAPH 1996). On one axis the shadows of boxes that move meet in one interval of time;
    # what all four intervals have in common is when the boxes do.
    "ttc": PairFunction(
        "time until the footprints first touch if both keep their velocity and do not turn",
        "s",
        "CASE WHEN meets <= parts AND parts >= 0 AND (rel_speed >= 1e-6 OR meets <= 0)"
        " AND reach1 + reach2 IS NOT NULL THEN greatest(meets, 0) END",
        note="0 where they overlap, NULL where they never touch or their velocities differ by less than"
        " 1e-6 m/s",
        dear=True,
    ),
    "headway": PairFunction(
        "time until a, at its speed, has come as far as b is now, from bumper to bumper",
        "s",
        "CASE WHEN lon > 0 AND pace > 0.1 AND la + lb IS NOT NULL THEN greatest(lon - la - lb, 0) / pace END",
        note="NULL where b is not ahead or a stands",
        alias="thw",
    ),
    "rel_speed": PairFunction(
        "length of the difference of the velocities", "m/s", "sqrt(dvx * dvx + dvy * dvy)"
    ),
    # Not by greatest(), which passes over NULL.
    "lon_gap": PairFunction(
        "how far the footprints are apart along a's axis",
        "m",
        "CASE WHEN out1 < 0 THEN 0 ELSE out1 END",
        note="0 where they overlap in it",
    ),
    "lat_gap": PairFunction(
        "how far the footprints are apart across a's axis",
        "m",
        "CASE WHEN out2 < 0 THEN 0 ELSE out2 END",
        note="0 where they overlap in it",
    ),
    # Scenic's apparent heading of b from a: Fremont et al., PLDI 2019, table 2.
    "apparent_heading": PairFunction(
        "b's heading less the direction from a to b: 0 is a tail, 180 a front",
        "degrees",
        f"CASE WHEN planar > 0 THEN {_turned('sighted')} END",
    ),
    "closing_time": PairFunction(
        "the gap at the closing speed, whether or not the ways meet",
        "s",
        "CASE WHEN closing_speed > 0 THEN gap / closing_speed END",
        note="NULL where the centres do not approach",
        dear=True,
    ),
    LANE_DIST: PairFunction(
        "from centre to centre along the lanes, negative where b is behind",
        "m",
        "",
        note="NULL beyond 200 m",
    ),
}
"""Numbers of two entities by name, in the order of the view; NULL where something that they need is missing."""

_PARTS: Final[Mapping[str, str]] = {
    **{f"d{axis}": f"b_{axis} - a_{axis}" for axis in ("x", "y", "z", "vx", "vy")},
    **{f"l{one}": f"{one}_length / 2" for one in "ab"},
    **{f"w{one}": f"{one}_width / 2" for one in "ab"},
    **{f"c{one}": f"cos({one}_heading)" for one in "ab"},
    **{f"s{one}": f"sin({one}_heading)" for one in "ab"},
    "planar": "sqrt(dx * dx + dy * dy)",
    "pace": "sqrt(a_vx * a_vx + a_vy * a_vy)",
    # The difference of two angles is exact for the headings that people write (0, π/2, π), where the angle of
    # turned components is not: the cosine of the double nearest to π/2 is 6e-17.
    "course": "CASE WHEN dx = 0 AND dy = 0 THEN 0 * a_heading ELSE degrees(atan2(dy, dx) - a_heading) END",
    "turned": "degrees(b_heading - a_heading)",
    "sighted": "degrees(b_heading - atan2(dy, dx))",
    # a's centre in b's axes, with the other sign
    "back": "dx * cb + dy * sb",
    "side": "dy * cb - dx * sb",
    # Between the headings; of parallel boxes two corners reach equally far, and each box takes the other one.
    "cosine": "ca * cb + sa * sb",
    "sine": "ca * sb - sa * cb",
    "co": "abs(cosine)",
    "si": "abs(sine)",
    "hand": "CASE WHEN cosine * sine < 0 THEN -1 ELSE 1 END",
    # Edges of the octagon, along and across a's axis and b's: their distance from a's centre, how far b's
    # centre lies beyond, and how far past their ends
    "reach1": "la + lb * co + wb * si",
    "reach2": "wa + lb * si + wb * co",
    "reach3": "lb + la * co + wa * si",
    "reach4": "wb + la * si + wa * co",
    "out1": "abs(lon) - reach1",
    "out2": "abs(lat) - reach2",
    "out3": "abs(back) - reach3",
    "out4": "abs(side) - reach4",
    "past1": "abs(CASE WHEN lon < 0 THEN -lat ELSE lat END - hand * (lb * si - wb * co)) - wa",
    "past2": "abs(CASE WHEN lat < 0 THEN -lon ELSE lon END - hand * (lb * co - wb * si)) - la",
    "past3": "abs(CASE WHEN back < 0 THEN -side ELSE side END + hand * (la * si - wa * co)) - wb",
    "past4": "abs(CASE WHEN side < 0 THEN -back ELSE back END + hand * (la * co - wa * si)) - lb",
    # On each of the four axes, turned so that b moves along it: b's place and speed, and from when to when the
    # boxes overlap. No speed is 0: two that stand on an axis meet there in ages, or have met for ages.
    "drift1": "dvx * ca + dvy * sa",
    "drift2": "dvy * ca - dvx * sa",
    "drift3": "dvx * cb + dvy * sb",
    "drift4": "dvy * cb - dvx * sb",
    **{
        f"place{i}": f"CASE WHEN drift{i} < 0 THEN -{at} ELSE {at} END"
        for i, at in enumerate(("lon", "lat", "back", "side"), 1)
    },
    **{f"rate{i}": f"abs(drift{i}) + 1e-200" for i in (1, 2, 3, 4)},
    "meets": f"greatest({', '.join(f'(-reach{i} - place{i}) / rate{i}' for i in (1, 2, 3, 4))})",
    "parts": f"least({', '.join(f'(reach{i} - place{i}) / rate{i}' for i in (1, 2, 3, 4))})",
    # Bounds that are cheap: no two boxes are nearer than their circumscribed circles (a micrometre makes up for
    # rounding), and of two that move straight on the distance shrinks by no more than this in a second.
    "at_least": "planar - sqrt(la * la + wa * wa) - sqrt(lb * lb + wb * wb) - 1e-6",
    "approach": "greatest(coalesce(closing_speed, 0), 0)",
}
"""Expressions that numbers share."""

_EXPRESSIONS: Final[Mapping[str, str]] = {
    **_PARTS,
    **{name: one.sql for name, one in PAIR_FUNCTIONS.items() if one.sql},
}
_NAME: Final = re.compile(r"\b[a-z]\w*\b(?!\()")
"""A part: words of SQL are in capitals, functions have a bracket behind them."""


@cache
def parts_of(name: str) -> tuple[str, ...]:
    """The numbers, parts and columns that a number of a pair is made of."""
    return tuple(sorted({*_NAME.findall(_EXPRESSIONS[name])}))


@cache
def stage_of(name: str) -> int:
    """Return the number of layers before a number of a pair; 0 for a column of an entity."""
    return 1 + max(stage_of(part) for part in parts_of(name)) if name in _EXPRESSIONS else 0


@cache
def needed_for(name: str) -> frozenset[str]:
    """A number of a pair with all that it is made of; nothing for one that is looked up."""
    if name == LANE_DIST:
        return frozenset()
    if name not in _EXPRESSIONS:
        return frozenset({name})
    return frozenset({name}).union(*(needed_for(part) for part in parts_of(name)))


def columns_needed(name: str) -> tuple[frozenset[str], frozenset[str]]:
    """The columns of a and those of b that a number of a pair is made of."""
    raw = [part for part in needed_for(name) if part not in _EXPRESSIONS]
    a, b = (frozenset(part[2:] for part in raw if part[0] == one) for one in "ab")
    return a, b


# SQL ----------------------------------------------------------------------------------------------


def pair_sql(name: str, column: Callable[[str], str]) -> str:
    """A number of a pair as SQL, given the columns of what it is made of."""
    return _NAME.sub(lambda found: column(found[0]), _EXPRESSIONS[name])


_KEPT: Final = ("frame_id", "src", "dst", "src_kind", "dst_kind", "src_is_ego", "dst_is_ego")
_BEFORE_KINDS: Final = 10
"""Numbers before the kinds in the view, which keeps the order of its columns; new ones come behind."""


def pairs_view() -> tuple[str, str]:
    """Return the statement of the view ``pairs``, without its head, and the documentation of its numbers."""
    listed = [(one.column or name, name) for name, one in PAIR_FUNCTIONS.items() if one.sql]
    wanted = frozenset[str]().union(*(needed_for(name) for _, name in listed))
    inputs = sorted(name for name in wanted if not stage_of(name))
    columns = ["b.frame_id", "a.node_id AS src", "b.node_id AS dst"]
    columns += ["a.kind AS src_kind", "b.kind AS dst_kind"]
    columns += ["a.is_ego AS src_is_ego", "b.is_ego AS dst_is_ego"]
    columns += [f"{name[0]}.{name[2:]}::DOUBLE AS {name}" for name in inputs]
    join = (
        "inside.state a JOIN inside.state b ON b.frame_id = a.frame_id AND b.node_id <> a.node_id"
    )
    text = f"SELECT {', '.join(columns)} FROM {join}"  # noqa: S608
    for stage in range(1, 1 + max(map(stage_of, wanted))):
        layer = [f"{pair_sql(n, str)} AS {n}" for n in sorted(wanted) if stage_of(n) == stage]
        text = f"SELECT *, {', '.join(layer)} FROM ({text})"  # noqa: S608
    numbers = [name if column == name else f"{name} AS {column}" for column, name in listed]
    shown = [*_KEPT[:3], *numbers[:_BEFORE_KINDS], *_KEPT[3:], *numbers[_BEFORE_KINDS:]]
    told = [f"{column}: {PAIR_FUNCTIONS[name].meaning}" for column, name in listed]
    return f"SELECT {', '.join(shown)} FROM ({text})", ". ".join(told)  # noqa: S608


# Arrays -------------------------------------------------------------------------------------------

Formula = Callable[[Mapping[str, Any]], Any]

COLUMNS: Final = ("x", "y", "z", "heading", "length", "width", "vx", "vy")
"""Columns of an entity that numbers of pairs are made of."""

_INPUTS: Final = [f"{one}_{name}" for one in "ab" for name in COLUMNS]


class PairNumbers(dict[str, "Floats"]):
    """Numbers of many ordered pairs by name, each computed when it is first asked for; (K,) float64.

    Parameters
    ----------
    a, b : (K, 8) float64
        ``x, y, z, heading, length, width, vx, vy`` of the two entities of pair k; m, m, m, rad, m, m, m/s, m/s.
        NaN where one is missing.
    """

    def __init__(self, a: Floats, b: Floats) -> None:
        super().__init__(zip(_INPUTS, (*a.T, *b.T), strict=True))

    def __missing__(self, name: str) -> Floats:
        with np.errstate(all="ignore"):
            found = self[name] = _compiled(name)(self)
        return found


def gap(a: Floats, b: Floats) -> Floats:
    """Shortest distance between the boxes of each pair; 0 where they touch or overlap.

    Parameters
    ----------
    a, b : (K, 5) float64
        ``x, y, heading, length, width`` of the two boxes of pair k; m, m, rad, m, m. A box without extent
        is a point or a line.

    Returns
    -------
    (K,) float64
        Metres; NaN where a number is missing.
    """
    found = np.empty(len(a))
    for start in range(0, len(a), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        boxes = [np.full((len(box[part]), len(COLUMNS)), np.nan) for box in (a, b)]
        for whole, box in zip(boxes, (a, b), strict=True):
            whole[:, _FOOTPRINT] = box[part]
        found[part] = PairNumbers(*boxes)["gap"]
    return found


_TOGETHER: Final = 1 << 14
"""Pairs whose parts are in memory at once: few enough for the caches of a processor."""

_FOOTPRINT: Final = [COLUMNS.index(name) for name in ("x", "y", "heading", "length", "width")]

# An expression is parsed as one of Python, which it is but for these words.
_AS_PYTHON: Final = tuple(
    (re.compile(pattern), text)
    for pattern, text in (
        (r"\bCASE WHEN\b", "case("),
        (r"\b(WHEN|THEN|ELSE)\b", ","),
        (r"\bEND\b", ")"),
        (r"\bIS NOT NULL\b", "is not None"),
        (r"\bIS NULL\b", "is None"),
        (r"\bNULL\b", "None"),
        (r"\bAND\b", "and"),
        (r"\bOR\b", "or"),
        (r"(?<![<>])=", "=="),
    )
)


def _case(*parts: Any) -> Any:
    """The first value whose condition is true, else the last, or NaN."""
    pairs, found = len(parts) // 2, parts[-1] if len(parts) % 2 else np.nan
    for i in reversed(range(pairs)):
        found = np.where(parts[2 * i], parts[2 * i + 1], found)
    return found


def _coalesced(value: Any, other: Any) -> Any:
    return np.where(np.isnan(value), other, value)


def _null_if(value: Any, other: Any) -> Any:
    return np.where(value == other, np.nan, value)


def _is_null(value: Any, _: Any) -> Any:
    return np.isnan(value)


def _is_known(value: Any, _: Any) -> Any:
    return ~np.isnan(value)


@cache
def _functions() -> Mapping[str, Callable[..., Any]]:
    """Functions of expressions by their names."""
    return {
        "case": _case,
        **{name: getattr(np, name) for name in ("abs", "sqrt", "sin", "cos", "degrees", "ceil")},
        "atan2": np.arctan2,
        # They pass over what is missing.
        "greatest": lambda *values: reduce(np.fmax, values),
        "least": lambda *values: reduce(np.fmin, values),
        "coalesce": _coalesced,
        "nullif": _null_if,
    }


@cache
def _operators() -> Mapping[type[ast.AST], Callable[..., Any]]:
    return {
        ast.Add: np.add,
        ast.Sub: np.subtract,
        ast.Mult: np.multiply,
        ast.Div: np.divide,
        ast.USub: np.negative,
        ast.Lt: np.less,
        ast.LtE: np.less_equal,
        ast.Gt: np.greater,
        ast.GtE: np.greater_equal,
        ast.Eq: np.equal,
        ast.Is: _is_null,
        ast.IsNot: _is_known,
        ast.And: np.logical_and,
        ast.Or: np.logical_or,
    }


@cache
def _compiled(name: str) -> Formula:
    """The function of the values of a number of pairs, given those of what it is made of.

    What is unknown in a condition is false, which is as good: no condition is negated.
    """
    text = _EXPRESSIONS[name]
    for pattern, python in _AS_PYTHON:
        text = pattern.sub(python, text)
    return _formula(ast.parse(text, mode="eval").body)


def _formula(node: ast.expr) -> Formula:  # noqa: PLR0911 - a case each
    match node:
        case ast.Constant(value=value):
            constant: Any = np.nan if value is None else value
            return lambda _: constant
        case ast.Name(id=name):
            return lambda at: at[name]
        case ast.Call(func=ast.Name(id=word), args=parts):
            return _applied(_functions()[word], parts)
        case ast.UnaryOp(op=op, operand=operand):
            return _applied(_operators()[type(op)], [operand])
        case ast.BinOp(op=op, left=left, right=right):
            return _applied(_operators()[type(op)], [left, right])
        case ast.Compare(ops=[op], left=left, comparators=[right]):
            return _applied(_operators()[type(op)], [left, right])
        case ast.BoolOp(op=op, values=parts):
            combine = _operators()[type(op)]
            return _applied(lambda *values: reduce(combine, values), parts)
        case _:
            raise TypeError(ast.unparse(node))


def _applied(function: Callable[..., Any], operands: list[ast.expr]) -> Formula:
    first, *others = parts = [_formula(operand) for operand in operands]
    if not others:
        return lambda at: function(first(at))
    if len(others) == 1:
        (second,) = others
        return lambda at: function(first(at), second(at))
    return lambda at: function(*(part(at) for part in parts))
