"""SQL expressions for the measures of object pairs, and SQL views of all pairs."""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._levels import UNEVEN, low_and_high_sql
from sgstore.model.pair_numbers._table import (
    EXPRESSIONS,
    MARKS,
    NAME,
    PAIR_FUNCTIONS,
    Marks,
    expression_of,
    needed_for,
    parts_of,
    stage_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


_WRITTEN_OUT: Final = 2000
"""Largest number of columns in an expanded measure that DuckDB may inline. ``ttc`` has 1,500."""


@cache
def _spelled(name: str) -> int:
    """Return how many columns the SQL expression of a measure contains if all its inputs are expanded."""
    if name not in EXPRESSIONS:
        return 1
    return sum(1 if _is_apart(part) else _spelled(part) for part in NAME.findall(EXPRESSIONS[name]))


@cache
def _is_apart(name: str) -> bool:
    """Return True if DuckDB must compute a measure separately, because its SQL is too large to repeat."""
    return name in MARKS or _spelled(name) > _WRITTEN_OUT


def pair_sql(name: str, column: Callable[[str], str], without: Marks = frozenset()) -> str:
    """Return a measure's SQL expression. ``column`` returns the SQL text for each of its inputs.

    DuckDB moves a condition below a layer by inlining the layer's expressions. For ``wttc`` these
    are 21 million columns, and for some others it takes a minute. A volatile column prevents this.
    Therefore a large number is made volatile, at no cost: the random function is not evaluated for
    known values.
    """
    text = NAME.sub(lambda found: column(found[0]), expression_of(name, without))
    return f"coalesce({text}, CASE WHEN random() > 2 THEN 0 END)" if _is_apart(name) else text


_KEPT: Final = ("frame_id", "src", "dst", "src_kind", "dst_kind", "src_is_ego", "dst_is_ego")

_BEFORE_KINDS: Final = 10
"""Names of measures before the kinds in the views. Later ones are appended, to keep the order of columns."""


def _is_of(name: str, one: str) -> bool:
    """Return True if an input of SQL expressions is a function (such as sine) of columns of one object only."""
    return "(" in EXPRESSIONS.get(name, "") and all(
        part[:2] == f"{one}_" and part not in EXPRESSIONS for part in parts_of(name)
    )


def _side(one: str, names: Sequence[str]) -> str:
    """Return SQL for the states of object a or b of a pair, with extra columns such as sines."""
    made = [f"{pair_sql(name, lambda n: f'{n[2:]}::DOUBLE')} AS {name}" for name in names]
    if one == "b":
        return f"(SELECT {', '.join(['*', *made])} FROM inside.state) b"  # noqa: S608
    # Once for each state of a, so that pairs of ordinary traces are almost free.
    bits = UNEVEN["near_flat"] | UNEVEN["near_storeys"] | UNEVEN["carried"]
    made.append(f"coalesce(t.uneven & {bits} <> 0, true) AS uneven")
    return (
        f"(SELECT {', '.join(['s.*', *made])} FROM inside.state s"  # noqa: S608
        " JOIN inside.trace t ON t.trace_id = s.frame_id >> 24) a"
    )


_DOUBTFUL: Final = (
    "CASE WHEN a.uneven THEN NOT coalesce(a.height > 0 AND b.height > 0"
    " AND abs(b.z - a.z) * 2 <= a.height + b.height, FALSE)"
    " OR coalesce(a.carrier = b.node_id OR b.carrier = a.node_id OR a.carrier = b.carrier, FALSE)"
    " ELSE FALSE END AS doubtful"
)
"""SQL test for pairs that may be special. Most pairs are not: their boxes are solid and overlap in height."""

_CALLED: Final = {
    "a_kind": "src_kind",
    "b_kind": "dst_kind",
    "a_node_id": "src",
    "b_node_id": "dst",
}
"""Input column of the special pairs test → column of the views."""


def _marked(pairs: str) -> str:
    """Return SQL that adds flags to object pairs: different storeys, or carrier and load."""
    heights = {
        f"{one}_{side}": made
        for one in "ab"
        for side, made in low_and_high_sql(partial(_of_side, one)).items()
    }
    sides = [f"CASE WHEN doubtful THEN {made} END AS {name}" for name, made in heights.items()]
    text = f"SELECT *, {', '.join(sides)} FROM ({pairs})"  # noqa: S608
    marks = [
        f"CASE WHEN doubtful THEN {pair_sql(mark, _part_of_mark)} ELSE 0e0 END AS {mark}"
        for mark in sorted(MARKS)
    ]
    return f"SELECT *, {', '.join(marks)} FROM ({text})"  # noqa: S608


def _of_side(one: str, name: str) -> str:
    return _CALLED[f"{one}_kind"] if name == "kind" else f"{one}_{name}::DOUBLE"


def _part_of_mark(name: str) -> str:
    return f"({EXPRESSIONS[name]})" if name in EXPRESSIONS else _CALLED.get(name, name)


def pairs_view(view: str = "pairs") -> tuple[str, str]:
    """Return the SQL of a view with all measures of object pairs, and comments for its columns.

    Parameters
    ----------
    view : str
        ``pairs``, or ``criticality``: its numbers and the measures of criticality.
    """
    listed = [
        (one.column or name, name)
        for name, one in PAIR_FUNCTIONS.items()
        if one.sql and one.view in {view, "pairs"}
    ]
    wanted = frozenset[str]().union(*(needed_for(name) for _, name in listed))
    wanted -= needed_for("level") | needed_for("solid")
    wanted |= frozenset().union(*(needed_for(name, MARKS) for _, name in listed))
    inputs = sorted(name for name in wanted if not stage_of(name))
    sides = {one: sorted(name for name in wanted if _is_of(name, one)) for one in "ab"}
    columns = ["b.frame_id", "a.node_id AS src", "b.node_id AS dst"]
    columns += ["a.kind AS src_kind", "b.kind AS dst_kind"]
    columns += ["a.is_ego AS src_is_ego", "b.is_ego AS dst_is_ego"]
    columns += [f"{name[0]}.{name[2:]}::DOUBLE AS {name}" for name in inputs]
    columns += [f"{one}.{name}" for one, names in sides.items() for name in names]
    columns += [
        f"{one}.{name} AS {one}_{name}" for one in "ab" for name in ("height", "pitch", "carrier")
    ]
    columns.append(_DOUBTFUL)
    joined = (
        f"{_side('a', sides['a'])} JOIN {_side('b', sides['b'])}"
        " ON b.frame_id = a.frame_id AND b.node_id <> a.node_id"
    )
    text = _marked(f"SELECT {', '.join(columns)} FROM {joined}")  # noqa: S608
    left = sorted(wanted.difference(*sides.values()))
    for stage in range(1, 1 + max(stage_of(name, MARKS) for name in left)):
        layer = [f"{pair_sql(n, str)} AS {n}" for n in left if stage_of(n, MARKS) == stage]
        text = f"SELECT *, {', '.join(layer)} FROM ({text})"  # noqa: S608
    numbers = [name if column == name else f"{name} AS {column}" for column, name in listed]
    shown = [*_KEPT[:3], *numbers[:_BEFORE_KINDS], *_KEPT[3:], *numbers[_BEFORE_KINDS:]]
    first = [(column, PAIR_FUNCTIONS[name]) for column, name in listed]
    told = [f"{column}: {one.meaning}" for column, one in first if one.view == view]
    return f"SELECT {', '.join(shown)} FROM ({text})", ". ".join(told)  # noqa: S608
