"""Named patterns as steps of a query, with new names for variables: ``MATCH cut_in(v = w)``.

A renamed variable has its new name everywhere in the pattern. Other variables keep their names, so the same
name is the same entity in every step.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any

from sgstore.lang.bind._symbols import RESERVED, THE_EGO
from sgstore.lang.syntax import tree as s

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from sgstore.lang.bind._symbols import Session


_NAMED = (s.NodePattern, s.EdgePattern, s.StepClause, s.Variable)


def values_given(
    step: s.ScenarioStep, parameters: Mapping[str, str], session: Session
) -> list[s.Argument]:
    """Return the arguments of a step that set parameters of its named pattern: ``cut_in(gap = 5)``.

    Parameters
    ----------
    step : ScenarioStep
    parameters : mapping of str to str
        Names of the parameters, each with an example value as text; empty if unknown.
    session : Session

    Raises
    ------
    QueryError
        The argument of a parameter is a variable.
    """
    found = [given for given in step.given if given.name in parameters]
    for given in found:
        if isinstance(given.value, s.Variable):
            default = parameters[given.name]
            session.refuse(
                f"'{given.name}' is a parameter of {step.name} and takes a value",
                given.span,
                f"such as {given.name} = {default}" if default else None,
            )
    return found


def own_names(
    step: s.ScenarioStep,
    steps: Sequence[s.StepClause],
    parameters: Iterable[str],
    taken: frozenset[str],
    session: Session,
) -> dict[str, str]:
    """Return the new variable names for a step that is a named pattern: old name → new name.

    Variables bound in braces are invisible outside. If their name is already used, they get a name that
    queries cannot write.

    Parameters
    ----------
    step : ScenarioStep
    steps : sequence of StepClause
        Steps of the pattern.
    parameters : iterable of str
        Parameters of the pattern. They take precedence over variables with the same name.
    taken : frozenset of str
        Names bound by the surrounding text.
    session : Session

    Raises
    ------
    QueryNameError
        Unknown parameter or variable.
    QueryError
        The argument of a variable is a value, or two variables would have the same name.
    """
    parameters, variables = list(parameters), list(dict.fromkeys(_variables(steps)))
    names: dict[str, str] = {}
    for given in step.given:
        if given.name in parameters:
            continue
        if given.name not in variables:
            known = [*parameters, *variables]
            session.unknown(f"parameter or variable of {step.name}", given.name, given.span, known)
        if not isinstance(given.value, s.Variable):
            session.refuse(
                f"'{given.name}' is a variable of {step.name} and takes the name of a variable of the query",
                given.span,
                f"such as {given.name} = a",
            )
        new = given.value.name
        if new in names.values():
            session.refuse(f"'{new}' renames two variables of {step.name}", given.span)
        names[given.name] = new
    for given in step.given:
        new = names.get(given.name)
        if new in variables and new not in names:
            session.refuse(
                f"'{new}' is a variable of {step.name} itself",
                given.span,
                f"rename that variable, too: {new} = …",
            )
    strange = taken.union(names.values()).difference(variables)
    return names | {name: f"{name}~" for name in strange}


def _variables(steps: Sequence[s.StepClause]) -> Iterator[str]:
    """Yield the names that steps define (nodes, edges, steps), then the variables in their conditions."""
    for step in steps:
        yield from (name for name in _bound(step.block) if name != THE_EGO)
        if step.name is not None:
            yield step.name
    for step in steps:
        yield from (n for n in _spoken_of(step.block, ()) if n not in {*RESERVED, THE_EGO})


def _bound(block: s.Block) -> list[str]:
    """Return the names of the nodes and edges of a graph pattern."""
    parts = [part for path in block.paths for part in (*path.nodes, *path.edges)]
    return [part.name for part in parts if part.name]


def _spoken_of(part: Any, own: tuple[str, ...]) -> Iterator[str]:
    """Yield the variables in part of a syntax tree, except those that an ``EXISTS {…}`` in it defines."""
    if isinstance(part, s.Variable):
        yield from () if part.name in own else (part.name,)
        return
    if isinstance(part, s.BlockExpression):
        own = (*own, *_bound(part.block))
    inner = part if isinstance(part, tuple) else ()
    if is_dataclass(part):
        inner = tuple(getattr(part, field.name) for field in fields(part))
    for one in inner:  # pyright: ignore[reportUnknownVariableType]
        yield from _spoken_of(one, own)


def names_written(sequence: s.SequenceClause) -> frozenset[str]:
    """Return all names that a sequence of steps defines or uses."""
    found: set[str] = set()
    for step in sequence.steps:
        if isinstance(step, s.GroupStep):
            found |= frozenset[str]().union(*map(names_written, step.alternatives))
        elif isinstance(step, s.StepClause):
            found |= set(_variables([step]))
        else:
            found |= {one.value.name for one in step.given if isinstance(one.value, s.Variable)}
    return frozenset(found)


def names_of_group(group: s.GroupStep) -> frozenset[str]:
    """Return the variables of a group of steps, except those with the label ``Ego``."""
    egos = {
        node.name
        for step in _steps_in(group)
        for path in step.block.paths
        for node in path.nodes
        if isinstance(node.label, s.Label) and node.label.name.lower() == "ego"
    }
    alone = s.SequenceClause((group,), (), group.span)
    return names_written(alone) - egos - {THE_EGO, *RESERVED}


def _steps_in(group: s.GroupStep) -> Iterator[s.StepClause]:
    for step in (one for sequence in group.alternatives for one in sequence.steps):
        if isinstance(step, s.GroupStep):
            yield from _steps_in(step)
        elif isinstance(step, s.StepClause):
            yield step


def names_returned(returns: s.Returns | None) -> frozenset[str]:
    """Return the names of the variables in a ``RETURN`` clause."""
    return frozenset(_spoken_of(returns, ())) if returns is not None else frozenset()


def renamed(step: s.StepClause, names: Mapping[str, str]) -> s.StepClause:
    """Return a copy of a sequence step in which variables have new names."""
    return _renamed(step, names) if names else step


def _renamed(part: Any, names: Mapping[str, str]) -> Any:
    if isinstance(part, tuple):
        return tuple(_renamed(one, names) for one in part)  # pyright: ignore[reportUnknownVariableType]
    if not is_dataclass(part) or isinstance(part, type):
        return part
    changed = {field.name: _renamed(getattr(part, field.name), names) for field in fields(part)}
    if isinstance(part, _NAMED) and part.name is not None:
        changed["name"] = names.get(part.name, part.name)
    return replace(part, **changed)
