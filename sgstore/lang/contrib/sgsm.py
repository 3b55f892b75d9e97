"""Translator of SGSM properties in the Scene Graph Language (SGL) to the query language.

The input is Python code for SGSM, with nested calls or nested ``partial``. It is parsed, but never run::

    lanes = partial(P.relSet, "Ego", "isIn")
    in_opposing_lane = P.gt(P.size(P.intersection(lanes, P.relSet(lanes, "opposes"))), 0)
    Property("Phi1", "G(~in_opposing_lane)", [("in_opposing_lane", in_opposing_lane)])

Sets of nodes become patterns, truth values become predicates without parameters, and properties become
``CHECK``. In SGL different sets may contain the same node, so the result has ``USING NODES any``.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryError, TextSpan
from sgstore.lang.bind import regex
from sgstore.lang.contrib._ltlf import LtlFormula
from sgstore.lang.syntax import parse
from sgstore.model.vocabulary import KINDS, LIGHT_STATES, relation_named

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


MAX_TEXT: Final = 1 << 20
"""Longest text accepted for translation; characters."""

MAX_NAMES: Final = 100
"""Longest chain of names that refer to other names."""

MAX_CALLS: Final = 100_000
"""Largest number of translated calls. Each use of a name counts all calls of its definition."""

_ATTRIBUTES: Final = {
    "carla_speed": "{0}.speed",
    "speed": "{0}.speed",
    # Positive steering is to the right in CARLA, and to the left in sgstore.
    "ego_control_carla_steer": "-{0}.steer",
    "ego_control_carla_throttle": "{0}.throttle",
    "ego_control_carla_brake": "{0}.brake",
    "light_state": "{0}.light_state",
    "carla_type_id": "{0}.type",
}
_COMPARISONS: Final = {"lt": "<", "gt": ">", "le": "<=", "ge": ">=", "eq": "=", "ne": "<>"}
_LOGIC: Final = {
    "logic_or": "OR",
    "logic_and": "AND",
    "logic_implies": "IMPLIES",
    "logic_xor": "XOR",
}
_TAKES: Final[Mapping[str, tuple[int, int]]] = {
    **dict.fromkeys(_COMPARISONS, (2, 2)),
    **dict.fromkeys(("logic_or", "logic_and"), (2, 100)),
    **dict.fromkeys(("logic_implies", "logic_xor"), (2, 2)),
    "logic_not": (1, 1),
    "size": (1, 1),
    "relSet": (2, 3),
    "relSetR": (2, 2),
    "filterByAttr": (3, 3),
    **dict.fromkeys(("intersection", "union", "difference", "symmetric_difference"), (2, 2)),
}
"""Smallest and largest number of arguments of each SGL function."""

MAX_NUMBER: Final = 1e300
"""Largest number that the query language permits."""

_SIGNS: Final[dict[type[ast.cmpop], str]] = {
    ast.Lt: "<",
    ast.Gt: ">",
    ast.LtE: "<=",
    ast.GtE: ">=",
    ast.Eq: "=",
    ast.NotEq: "<>",
}


def translated(text: str) -> str:
    """Translate the text of SGSM properties to the query language.

    Parameters
    ----------
    text : str
        Python source: assignments, and calls of ``Property(name, formula, [(proposition, value), …])``.

    Returns
    -------
    str
        A ``DEFINE PREDICATE`` for each proposition and a ``CHECK`` for each property; without properties, a
        predicate for each assignment that is a truth value.

    Raises
    ------
    QueryError
        Invalid Python, or a part that SGL does not have. The error has the place.
    """
    if len(text) > MAX_TEXT:
        raise QueryError(f"the text has {len(text)} characters; {MAX_TEXT} are allowed")
    try:
        tree = ast.parse(text)
    except SyntaxError as error:
        reason = f"invalid Python: {error.msg}"
        raise QueryError(reason, text=text, span=_place(text, error)) from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise QueryError(f"invalid Python: {error}") from None
    try:
        found = _Translation(text).all(tree)
    except RecursionError:
        raise QueryError("the expressions are nested too deeply, perhaps through names") from None
    _check(found)
    if not found.strip():
        hint = "Property('name', 'G(~a)', [('a', P.gt(P.size(…), 0))])"
        raise QueryError("it contains neither a property nor a truth value", hint=hint)
    return found


def _check(found: str) -> None:
    """Raise an error if the text of a translation is not valid in the query language."""
    if not found.strip():
        return
    try:
        parse(found)
    except QueryError as error:
        reason = f"the query language cannot express this: {error.reason}"
        raise QueryError(reason, text=found, span=error.span, hint=error.hint) from None


def _place(text: str, error: SyntaxError) -> TextSpan:
    before = text.split("\n")[: (error.lineno or 1) - 1]
    start = sum(len(line) + 1 for line in before) + max((error.offset or 1) - 1, 0)
    return TextSpan(min(start, len(text)), min(start, len(text)) + 1)


@dataclass
class _Found:
    """Set of scene graph nodes, written as a pattern. ``node`` is the variable for its members."""

    node: str
    label: str = ""
    paths: list[str] = field(default_factory=list[str])
    where: list[str] = field(default_factory=list[str])

    def text(self) -> str:
        """Return the text of the pattern: the paths and conditions inside ``EXISTS {…}``."""
        paths = self.paths or [f"({self.node}{self.label})"]
        return ", ".join(paths) + (f" WHERE {' AND '.join(self.where)}" if self.where else "")


class _Translation:
    def __init__(self, text: str) -> None:
        self._text = text
        self._names: dict[str, ast.expr] = {}
        self._numbers = 0
        self._calls = 0
        self._defined: dict[str, str] = {}

    def all(self, tree: ast.Module) -> str:
        checks: list[str] = []
        for statement in tree.body:
            if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
                if _function(statement.value) == "Property":
                    checks.append(self._property(statement.value))
                else:
                    self._names[statement.targets[0].id] = statement.value
            elif isinstance(statement, ast.Expr) and _function(statement.value) == "Property":
                checks.append(self._property(statement.value))
            elif not isinstance(statement, ast.Import | ast.ImportFrom | ast.Expr):
                raise self._refused("expected an assignment or a Property", statement)
        if not checks:
            for name, value in self._names.items():
                if _function(value) in {*_COMPARISONS, *_LOGIC, "logic_not"}:
                    self._define(name, value)
        defined = [f"DEFINE PREDICATE {name}() AS {text};" for name, text in self._defined.items()]
        return "\n".join([*defined, *checks]) + "\n"

    # Properties

    def _property(self, call: ast.expr) -> str:
        values = (
            [*call.args, *(k.value for k in call.keywords)] if isinstance(call, ast.Call) else []
        )
        if len(values) < 3:
            raise self._refused("expected Property(name, formula, [(proposition, value), …])", call)
        name, formula = (self._constant(value, str) for value in values[:2])
        for proposition, value in self._pairs(values[2]):
            self._define(proposition, value)
        checked = LtlFormula(formula, self._defined).text()
        called = re.sub(r"\W", "_", name)
        return f"USING NODES any CHECK {called}: {checked};"

    def _pairs(self, value: ast.expr) -> list[tuple[str, ast.expr]]:
        value = self._resolved(value)
        if isinstance(value, ast.Dict):
            items = zip(value.keys, value.values, strict=True)
            return [(self._constant(key, str), item) for key, item in items if key is not None]
        if not isinstance(value, ast.List | ast.Tuple):
            raise self._refused("expected a list of pairs (proposition, value)", value)
        pairs: list[tuple[str, ast.expr]] = []
        for item in value.elts:
            if not isinstance(item, ast.Tuple | ast.List) or len(item.elts) < 2:
                raise self._refused("expected a pair (proposition, value)", item)
            pairs.append((self._constant(item.elts[0], str), item.elts[1]))
        return pairs

    def _define(self, name: str, value: ast.expr) -> None:
        if not name.isidentifier():
            raise self._refused(f"{name!r} is not a name", value)
        text = self.truth(value)
        if self._defined.setdefault(name, text) != text:
            raise self._refused(f"{name} is defined twice, and differently", value)

    # Truth values and numbers

    def truth(self, value: ast.expr) -> str:
        """Translate an SGL formula with a truth value to a query condition."""
        word, arguments = self._call(value)
        if word in _COMPARISONS:
            return self._comparison(_COMPARISONS[word], *arguments)
        if word in _LOGIC:
            return (
                "(" + f" {_LOGIC[word]} ".join(self.truth(argument) for argument in arguments) + ")"
            )
        if word == "logic_not":
            return f"NOT ({self.truth(arguments[0])})"
        raise self._refused(f"expected a truth value, found {word}", value)

    def _comparison(self, sign: str, left: ast.expr, right: ast.expr) -> str:
        number = self._number(right)
        if number == "0" and _function(self._resolved(left)) == "size" and sign in {">", "="}:
            block = f"EXISTS {{{self._set(self._call(left)[1][0]).text()}}}"
            return block if sign == ">" else f"NOT {block}"
        return f"{self._number(left)} {sign} {number}"

    def _number(self, value: ast.expr) -> str:
        value = self._resolved(value)
        if isinstance(value, ast.UnaryOp) and isinstance(value.op, ast.USub | ast.UAdd):
            sign = "-" if isinstance(value.op, ast.USub) else ""
            return sign + self._written(self._resolved(value.operand), value)
        if isinstance(value, ast.Constant) and not isinstance(value.value, str):
            return self._written(value, value)
        word, arguments = self._call(value)
        if word != "size":
            raise self._refused(f"expected a number or size(…), found {word}", value)
        # Members are counted, not the matches of the pattern.
        found = self._set(arguments[0])
        if not found.paths:
            return f"COUNT {{{found.text()}}}"
        member = self._name()
        return f"COUNT {{({member}) WHERE {self._member(arguments[0], member)}}}"

    def _written(self, value: ast.expr, at: ast.expr) -> str:
        """Translate an SGL formula for a number to the query language."""
        number = value.value if isinstance(value, ast.Constant) else None
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise self._refused("expected a number", at)
        if not abs(number) <= MAX_NUMBER:
            raise self._refused("the number is too large", at)
        return repr(float(number)) if abs(number) >= 2**63 else repr(number)

    # Sets of nodes

    def _set(self, value: ast.expr, node: str = "") -> _Found:
        """Translate an SGL formula for a set of nodes to a pattern.

        ``node`` is the variable name for its members.
        """
        node = node or self._name()
        value = self._resolved(value)
        if isinstance(value, ast.Constant) and value.value in {"Ego", "G"}:
            return _Found(node, ":Ego" if value.value == "Ego" else "")
        if isinstance(value, ast.Name) and value.id in {"Ego", "G"}:
            return _Found(node, ":Ego" if value.id == "Ego" else "")
        word, arguments = self._call(value)
        makers: Mapping[str, Callable[..., _Found]] = {
            "relSet": self._related,
            "relSetR": self._related_back,
            "filterByAttr": self._filtered,
            "intersection": self._intersection,
            "union": self._union,
            "difference": self._difference,
            "symmetric_difference": self._symmetric_difference,
        }
        if word not in makers:
            raise self._refused(f"expected a set of nodes, found {word}", value)
        return makers[word](node, *arguments)

    def _related(
        self, node: str, of: ast.expr, relation: ast.expr, edge: ast.expr | None = None
    ) -> _Found:
        back = edge is not None and self._constant(edge, str) == "incoming"
        return self._along(node, of, relation, back=back)

    def _related_back(self, node: str, of: ast.expr, relation: ast.expr) -> _Found:
        return self._along(node, of, relation, back=True)

    def _along(self, node: str, of: ast.expr, relation: ast.expr, *, back: bool) -> _Found:
        name = self._constant(relation, str)
        known = relation_named("safety_hazard" if name == "safe_hazard" else name)
        if known is None:
            raise self._refused(f"unknown relation '{name}'", relation)
        inner = self._set(of)
        label = "" if inner.paths else inner.label
        ends = (f"({inner.node}{label})", f"({node})")
        path = f"{ends[1]}-[:{known}]->{ends[0]}" if back else f"{ends[0]}-[:{known}]->{ends[1]}"
        return _Found(node, "", [*inner.paths, path], inner.where)

    def _filtered(self, node: str, of: ast.expr, attribute: ast.expr, test: ast.expr) -> _Found:
        found = self._set(of, node)
        name = self._constant(attribute, str)
        found.where.append(self._condition(node, name, self._resolved(test)))
        return found

    def _condition(self, node: str, name: str, test: ast.expr) -> str:
        if isinstance(test, ast.Constant) and isinstance(test.value, str):
            return self._resembling(node, name, test)
        if name not in _ATTRIBUTES:
            raise self._refused(f"unknown attribute '{name}'", test)
        if not isinstance(test, ast.Lambda) or not isinstance(test.body, ast.Compare):
            raise self._refused("expected a text, or lambda x: x < number", test)
        compared = test.body
        sign = _SIGNS.get(type(compared.ops[0]))
        variable = test.args.args[0].arg if test.args.args else ""
        if sign is None or len(compared.ops) > 1 or not _is_name(compared.left, variable):
            raise self._refused("expected lambda x: x < number", test)
        return f"{_ATTRIBUTES[name].format(node)} {sign} {self._number(compared.comparators[0])}"

    def _resembling(self, node: str, name: str, test: ast.Constant) -> str:
        """Translate a regular expression of an SGL formula to a condition that lists the matching values."""
        try:
            wanted = regex(str(test.value))
        except re.error as error:
            raise self._refused(f"invalid regular expression: {error}", test) from None
        if name in {"name", "base_class"}:
            words = {kind: (kind, *_OTHER_NAMES.get(kind, ())) for kind in KINDS}
            kinds = [kind for kind in KINDS if any(wanted.search(word) for word in words[kind])]
            return self._among(f"{node}.kind", kinds, test)
        if name == "light_state":
            # CARLA has no combined red and yellow state.
            plain = [state for state in LIGHT_STATES if "_" not in state]
            found = [state for state in plain if wanted.search(state.capitalize())]
            return self._among(f"{node}.light_state", found, test)
        if name == "carla_type_id":
            text = str(test.value).replace("'", "''")
            return f"{node}.type =~ '.*({text}).*'"
        raise self._refused(f"unknown attribute '{name}'", test)

    def _among(self, what: str, words: list[str], test: ast.Constant) -> str:
        if not words:
            raise self._refused(f"no name matches '{test.value}'", test)
        return f"{what} IN [{', '.join(repr(word) for word in words)}]"

    def _intersection(self, node: str, one: ast.expr, other: ast.expr) -> _Found:
        first, second = self._set(one, node), self._set(other, node)
        label = first.label or second.label
        if first.label and second.label and first.label != second.label:
            raise self._refused("two labels", other)
        paths = [*first.paths, *second.paths]
        if paths and label:  # the ego of one side is a condition on the paths of the other
            return _Found(node, "", paths, [*first.where, *second.where, f"{node}.is_ego"])
        return _Found(node, label, paths, [*first.where, *second.where])

    def _union(self, node: str, one: ast.expr, other: ast.expr) -> _Found:
        either = f"({self._member(one, node)} OR {self._member(other, node)})"
        return _Found(node, "", [], [either])

    def _difference(self, node: str, one: ast.expr, other: ast.expr) -> _Found:
        found = self._set(one, node)
        found.where.append(f"NOT {self._member(other, node)}")
        return found

    def _symmetric_difference(self, node: str, one: ast.expr, other: ast.expr) -> _Found:
        return _Found(
            node, "", [], [f"({self._member(one, node)} XOR {self._member(other, node)})"]
        )

    def _member(self, of: ast.expr, node: str) -> str:
        """Return a condition: true if a node is in a set of an SGL formula."""
        found = self._set(of, node)
        if found.paths:
            return f"EXISTS {{{found.text()}}}"
        parts = ([f"{node}.is_ego"] if found.label else []) + found.where
        return f"({' AND '.join(parts)})" if parts else "TRUE"

    # Python

    def _name(self) -> str:
        self._numbers += 1
        return f"n{self._numbers}"

    def _resolved(self, value: ast.expr) -> ast.expr:
        """Return the expression that the SGL text assigns to a name. Return other expressions as they are."""
        for _ in range(MAX_NAMES):
            if not isinstance(value, ast.Name) or value.id not in self._names:
                return value
            value = self._names[value.id]
        raise self._refused("a name is defined by itself", value)

    def _call(self, value: ast.expr) -> tuple[str, list[ast.expr]]:
        """Return the function name and the arguments of a Python call or a ``functools.partial``."""
        value = self._resolved(value)
        if not isinstance(value, ast.Call):
            raise self._refused("expected a call", value)
        self._calls += 1
        if self._calls > MAX_CALLS:
            raise self._refused(f"more than {MAX_CALLS} calls through names", value)
        name, arguments = _function(value), [*value.args, *(k.value for k in value.keywords)]
        if name == "partial" and arguments:
            name, arguments = _last_name(arguments[0]), arguments[1:]
        low, high = _TAKES.get(name, (0, len(arguments)))
        if not low <= len(arguments) <= high:
            wanted = str(low) if low == high else f"{low} or {high if high == low + 1 else 'more'}"
            many = f"{wanted} argument{'s' * (wanted != '1')}"
            raise self._refused(f"{name} takes {many}, found {len(arguments)}", value)
        return name, arguments

    def _constant(self, value: ast.expr | None, kind: type) -> Any:
        value = self._resolved(value) if value is not None else None
        if not isinstance(value, ast.Constant) or not isinstance(value.value, kind):
            raise self._refused("expected a text", value)
        return value.value

    def _refused(self, reason: str, at: ast.AST | None) -> QueryError:
        if not isinstance(at, ast.expr | ast.stmt):
            return QueryError(reason, text=self._text)
        start = self._offset(at.lineno, at.col_offset)
        end = self._offset(at.end_lineno or at.lineno, at.end_col_offset or at.col_offset)
        return QueryError(reason, text=self._text, span=TextSpan(start, max(end, start + 1)))

    def _offset(self, line: int, column: int) -> int:
        """Convert a position in Python source (line, byte) to an index in the text."""
        lines = _LINE.findall(self._text)  # only line ends that Python accepts
        text = lines[line - 1] if line <= len(lines) else ""
        inside = text.encode(errors="replace")[:column].decode(errors="replace")
        return min(sum(map(len, lines[: line - 1])) + len(inside), len(self._text))


_OTHER_NAMES: Final = {"off_road": ("Off Road",), "person": ("walker", "pedestrian")}
"""Names of kinds in CARLASGG."""


_LINE: Final = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")


def _function(value: ast.expr) -> str:
    """Return the name of the called function without its module.

    Expressions other than calls give an empty text.
    """
    return _last_name(value.func) if isinstance(value, ast.Call) else ""


def _last_name(value: ast.expr) -> str:
    if isinstance(value, ast.Attribute):
        return value.attr
    return value.id if isinstance(value, ast.Name) else ""


def _is_name(value: ast.expr, name: str) -> bool:
    return isinstance(value, ast.Name) and value.id == name
