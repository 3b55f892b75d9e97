"""Ratchets: figures of the code base that may only fall. No test asserts that a clock shows little."""

from __future__ import annotations

import ast
from pathlib import Path

import house

TESTS = Path(__file__).parents[1]
CLOCKS = {"perf_counter", "process_time", "thread_time", "monotonic"}
CLOCKS |= {"time.time", *(f"{name}_ns" for name in (*CLOCKS, "time"))}


def test_no_figure_rises() -> None:
    found = house.figures(house.survey(), house.walks(names=False))

    assert house.risen(found) == [], "see tools/house.py"


def test_files_import_one_another_in_one_direction() -> None:
    assert house.survey().circles() == []


def test_no_two_classes_have_one_name() -> None:
    assert house.survey().twice() == {}


def test_a_figure_above_its_ratchet_is_named() -> None:
    known = house.kept()
    found = {table: dict(values) for table, values in known.items()}
    found["code"]["files"] += 1
    found["code"]["new figure"] = 0

    files = int(known["code"]["files"])
    assert house.risen(found) == [
        f"files: {files + 1}, at most {files}",
        "new figure: 0, at most nothing",
    ]
    assert house.lowered(known | {"code": known["code"] | {"files": 1}}) != house.lowered(known)


def timed(node: ast.AST, names: set[str]) -> bool:
    """True if an expression reads a clock, or a name whose value comes from a clock."""
    parts = [part for part in ast.walk(node) if isinstance(part, (ast.Name, ast.Attribute))]
    return any(
        {ast.unparse(part), ast.unparse(part).removeprefix("time.")} & names for part in parts
    )


def given(node: ast.AST) -> list[tuple[ast.AST, ast.AST]]:
    """Pairs of a name and a value that a statement gives it; a function has the values it returns."""
    match node:
        case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
            return [*zip(names, values, strict=False)]
        case ast.Assign(targets=targets, value=value):
            return [(part, value) for target in targets for part in ast.walk(target)]
        case ast.AugAssign(target=target, value=value) | ast.NamedExpr(target=target, value=value):
            return [(target, value)]
        case ast.Call(func=ast.Attribute(value=held, attr="append"), args=[value]):
            return [(held, value)]
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
            ends = [part.value for part in ast.walk(node) if isinstance(part, ast.Return)]
            return [(ast.Name(name), end) for end in ends if end]
    return []


def hasty(source: str) -> list[int]:
    """Lines of assertions that are true only if a clock shows less than a bound."""
    tree, lines = ast.parse(source), set[int]()
    for function in ast.walk(tree):
        if not isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        if not timed(function, CLOCKS):
            continue
        pairs = [pair for node in ast.walk(function) for pair in given(node)]
        names, before = set(CLOCKS), set[str]()
        while names != before:
            before = set(names)
            names |= {
                to.id for to, value in pairs if isinstance(to, ast.Name) and timed(value, names)
            }
        checks = (node.test for node in ast.walk(function) if isinstance(node, ast.Assert))
        for compared in (part for check in checks for part in ast.walk(check)):
            if not isinstance(compared, ast.Compare):
                continue
            sides = [compared.left, *compared.comparators]
            for operator, left, right in zip(compared.ops, sides, sides[1:], strict=False):
                small = left if isinstance(operator, (ast.Lt, ast.LtE)) else right
                if isinstance(operator, (ast.Lt, ast.LtE, ast.Gt, ast.GtE)) and timed(small, names):
                    lines.add(compared.lineno)
    return sorted(lines)


def test_no_test_fails_on_a_busy_machine_by_its_clock() -> None:
    files = [path for path in TESTS.rglob("*.py") if any(map(path.read_text().count, CLOCKS))]

    assert {str(path): lines for path in files if (lines := hasty(path.read_text()))} == {}


def test_an_assertion_on_a_clock_is_found() -> None:
    assert hasty(
        """
def test_short():
    start = time.process_time()
    work()
    cost, peak = process_time() - start, 3
    waited.append(cost)
    def spent():
        return cost
    assert peak <= 64 or cost < 2
    assert sorted(waited)[2] < 5
    assert 5 > spent()
    assert 0.2 <= cost
    assert 0.2 <= perf_counter() - start < 1
    assert len(found) < 5
"""
    ) == [9, 10, 11, 13]


def test_a_lower_bound_on_a_clock_is_allowed() -> None:
    source = "def test(): assert 0.2 < time.monotonic() - start and len(rows) < 5"

    assert hasty(source) == []
