"""Formulas and plans as text, for ``explain``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sgstore.lang.found import relation
from sgstore.lang.printing import value_text
from sgstore.temporal.formulas import (
    And,
    Bound,
    Constant,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    Until,
)

if TYPE_CHECKING:
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.over_time import Hold, Length, Link
    from sgstore.lang.results import Statement
    from sgstore.temporal.plans import Plan


def formula_text(formula: Formula) -> str:  # noqa: C901, PLR0911 - a case each
    """A formula as one would write it, with the names of its propositions."""
    match formula:
        case Constant(value=value):
            return str(value).upper()
        case Proposition(name=name):
            return name
        case Not(operand=Not(operand=operand)):
            return formula_text(operand)
        case Not(operand=operand):
            return f"NOT {formula_text(operand)}"
        case And(operands=operands):
            return "(" + " AND ".join(map(formula_text, operands)) + ")"
        case Or(operands=operands):
            return "(" + " OR ".join(map(formula_text, operands)) + ")"
        case Next(operand=operand, weak=weak):
            return f"{'WEAK' * weak}NEXT {formula_text(operand)}"
        case Previous(operand=operand):
            return f"PREVIOUS {formula_text(operand)}"
        case Until(left=left, right=right, bound=bound):
            return f"({formula_text(left)} UNTIL{bound_text(bound)} {formula_text(right)})"
        case Since(left=left, right=right, bound=bound):
            return f"({formula_text(left)} SINCE{bound_text(bound)} {formula_text(right)})"


def bound_text(bound: Bound) -> str:
    """A bound; nothing for one that is none."""
    if bound == Bound():
        return ""
    ends = [_length(bound.low, bound), "INF" if bound.high is None else _length(bound.high, bound)]
    return f"[{', '.join(ends)}]"


def _length(amount: int, bound: Bound) -> str:
    return f"{amount}frames" if bound.frames else f"{amount / 1e9:g}s"


def plan_text(
    plan: Plan, formula: Formula, reset: Formula | None, catalog: Catalog | None = None
) -> str:
    """A plan: the formula, and what each of its propositions is; with a catalog, also the SQL of the atoms."""
    lines = [f"formula {formula_text(formula)}"]
    lines += [f"reset {formula_text(reset)}"] if reset is not None else []
    lines += needs_text(plan, catalog)
    return "\n".join(lines)


def needs_text(plan: Plan, catalog: Catalog | None = None) -> list[str]:
    """What a plan needs of single frames, a line each; with a catalog, also the SQL."""
    lines: list[str] = []
    for atom in plan.atoms.values():
        where = " AND ".join(value_text(part) for part in atom.query.scope.where) or "TRUE"
        lines.append(f"atom {atom.name}({', '.join(atom.variables)}) = {where}")
        lines += [] if catalog is None else sql_text(relation(atom.query, catalog, None))
    for signal in plan.signals.values():
        told = value_text(signal.value)
        lines.append(f"signal {signal.name}({', '.join(signal.variables)}) = {told}")
        if catalog is not None:
            lines += sql_text(relation(signal.query, catalog, None, (signal.value,)))
    for test in plan.tests.values():
        lines.append(
            f"test {test.name}({', '.join(test.variables)}) = {value_text(test.expression)}"
        )
    return lines


def sql_text(statement: Statement) -> list[str]:
    """A statement, indented, with the values that it binds."""
    lines = [f"    {line}" for line in statement.sql.splitlines()]
    return lines + [f"    ${n} = {value!r}" for n, value in enumerate(statement.values, start=1)]


def hold_text(hold: Hold) -> str:
    """How long a step must last."""
    inclusive = " INCLUSIVE" if hold.inclusive else ""
    return f"for {hold.comparison} {length_text(hold.length)}{inclusive}"


def link_text(link: Link) -> str:
    """When a step comes after the one before."""
    after = f" after {length_text(link.after)}" if link.after else ""
    within = f" within {length_text(link.within)}" if link.within else ""
    return f"{link.kind}{after}{within}"


def length_text(length: Length) -> str:
    """A length of time."""
    return f"{length.amount}frames" if length.frames else f"{length.amount / 1e9:g}s"
