"""Functions that implement the methods of :class:`sgstore.query.StoreVerbs` and the command line."""

from __future__ import annotations

import re
import sys
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ConfigError, ExportError, one_store_needed
from sgstore.lang.library import pattern_named, statement
from sgstore.model.world import Clip
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping, Sequence

    from sgstore.collection import Collection
    from sgstore.draw import Timeline
    from sgstore.exporters import Exporter, WrittenClip, WrittenFile
    from sgstore.matches import Matches
    from sgstore.testsets.coverage import ChosenFrames, Classed, ReportTable
    from sgstore.testsets.locks import Lock
    from sgstore.testsets.selection import Prioritized, PrioritySpec, Selection, SelectionSpec

    Place = str | Path | Store | Collection

_TIME: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(ms|s|min)?")
_UNIT: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, None: 1.0}


def seconds(value: str | float, option: str) -> float:
    """Return a time in seconds, from a number or a text such as ``2s``, ``500ms`` or ``1min``.

    Raises
    ------
    ConfigError
        The text is not a time.
    """
    if not isinstance(value, str):
        return float(value)
    match = _TIME.fullmatch(value.strip())
    if match is None:
        raise ConfigError(f"{option} {value!r}: expected a time such as 2s, 500ms or 1min")
    return float(match[1]) * _UNIT[match[2]]


def one_store(store: Store | Collection) -> Store:
    """Return the store. Raise an error for a collection."""
    if isinstance(store, Store):
        return store
    raise one_store_needed(store.place.url)


def chosen_frames(
    store: Store | Collection, query: str, parameters: Mapping[str, object] | None, name: str = ""
) -> ChosenFrames:
    """Return the frames for a command: frames that match a query, or all frames without a query."""
    from sgstore.testsets.coverage import ChosenFrames, frames_of

    name = name or (str(store.file.path) if isinstance(store, Store) else store.place.url)
    if not query:
        if parameters:
            raise ConfigError("--param (parameters) needs a QUERY")
        return ChosenFrames(name, store)
    text, values = statement(query, parameters or {})
    matches = store.find(text, **values)
    about = matches.reasons, query, parameters or {}, matches.notes
    found = frames_of(store, text, **values)
    return ChosenFrames(f"{name}:{query}", store, found, *about)


def frames_at(place: Place) -> ChosenFrames:
    """Return the frames of a store, a collection, or a text such as ``STORE:QUERY``."""
    from sgstore.testsets.coverage import selection_of

    if isinstance(place, str | Path):
        return selection_of(str(place))
    return chosen_frames(place, "", None)


def select(store: Store | Collection, *, query: str, parameters: Any, **options: Any) -> Selection:
    """Select test cases; see :meth:`sgstore.query.StoreVerbs.select`."""
    from sgstore.testsets.selection import select as choose

    spec = selection_spec(**options)  # reject wrong options before the search
    return choose(chosen_frames(store, query, parameters), spec)


def selection_spec(  # noqa: PLR0913 - the options of the command
    *,
    minimal: bool,
    per_class: int | None,
    rarest: bool,
    stratify: str,
    weakest: str,
    budget: str,
    clip: str | float,
    stride: str | float,
    within: str | float,
    manoeuvres: Sequence[str],
    **same: Any,
) -> SelectionSpec:
    """Return the specification of a selection from the options of ``select``."""
    from sgstore.testsets.selection import Budget, SelectionSpec, SelectionUnit, Strategy

    ways = {
        Strategy.minimal: minimal,
        Strategy.rarest: rarest,
        Strategy.stratify: bool(stratify),
        Strategy.per_class: per_class is not None and not stratify,
        Strategy.weakest: bool(weakest),
    }
    asked = [way for way, wanted in ways.items() if wanted]
    if len(asked) > 1:
        known = "--minimal, --per-class, --rarest, --stratify, --weakest"
        raise ConfigError(f"expected one of {known}")
    return SelectionSpec(
        asked[0] if asked else Strategy.every,
        SelectionUnit(one_of("--unit", same.pop("unit"), SelectionUnit)),
        seconds(clip, "--clip"),
        each=per_class or (0 if stratify else 1),
        by=stratify or weakest,
        budget=Budget.parse(budget) if budget else None,
        stride_s=seconds(stride, "--stride") if stride else None,
        manoeuvres=tuple(manoeuvres),
        within_s=seconds(within, "--within"),
        **same,
    )


def one_of(option: str, value: str, known: Iterable[str]) -> str:
    """Return the value of an option. Raise an error if the value is not in the list of known values.

    Raises
    ------
    ConfigError
    """
    if value not in [*known]:
        raise ConfigError(f"{option} {value!r}: expected one of {', '.join(known)}")
    return value


def prioritize(
    store: Store | Collection,
    *,
    query: str,
    parameters: Any,
    outcomes: str | Path | None,
    learn_outcomes: str | Path | None,
    learn_from: Place | None,
    **options: Any,
) -> Prioritized:
    """Order test cases; see :meth:`sgstore.query.StoreVerbs.prioritize`."""
    from sgstore.testsets.coverage import read_outcomes
    from sgstore.testsets.selection import prioritize as put_in_order

    spec = priority_spec(**options)
    if spec.by != "learned" and (learn_outcomes or learn_from):
        raise ConfigError("--learn-outcomes and --learn-from need --order learned")
    if learn_from is not None and learn_outcomes is None:
        raise ConfigError("--learn-from needs --learn-outcomes")
    known = learn_outcomes or outcomes
    if spec.by == "learned" and known is None:
        raise ConfigError("--order learned needs --outcomes or --learn-outcomes")
    training = None if known is None else read_outcomes(known)
    source = None if learn_from is None else frames_at(learn_from)
    chosen = chosen_frames(one_store(store), query, parameters)
    return put_in_order(chosen, spec, training, source)


def priority_spec(
    *, order: str, measures: Sequence[str], clip: str | float, budget: str, unit: str, **same: Any
) -> PrioritySpec:
    """Return the specification of an order from the options of ``prioritize``."""
    from sgstore.testsets.selection import MEASURES, Budget, Priority, PrioritySpec, SelectionUnit

    return PrioritySpec(
        Priority(one_of("--order", order, Priority)),
        tuple(measures or MEASURES),
        SelectionUnit(one_of("--unit", unit, SelectionUnit)),
        seconds(clip, "--clip"),
        budget=Budget.parse(budget) if budget else None,
        **same,
    )


def criticality(
    store: Store | Collection, *, measures: Sequence[str], most: float | None
) -> ReportTable:
    """List measures of encounters; see :meth:`sgstore.query.StoreVerbs.criticality`."""
    from sgstore.model.criticality import RECORDED, recorded
    from sgstore.testsets.coverage import ReportTable

    chosen = tuple(measures or RECORDED)
    found = recorded(one_store(store), chosen)
    first = found.columns.index("kind") + 1
    signs = [-1 if RECORDED[name].worse == "high" else 1 for name in chosen]

    def harm(row: tuple[Any, ...]) -> list[tuple[bool, float]]:
        values = zip(row[first:], signs, strict=True)
        return [(value is None, 0 if value is None else sign * value) for value, sign in values]

    rows = [
        row
        for row in found.values
        if any(value is not None for value in row[first:])
        and (most is None or (row[first] is not None and row[first] <= most))
    ]
    return ReportTable(found.columns, sorted(rows, key=harm))


def coverage(  # noqa: PLR0913 - the options of the command
    store: Store | Collection,
    *,
    kind: str,
    query: str,
    by: Place | None,
    slots: str | Path | None,
    missing: bool,
    covered: bool,
    parameters: Any,
    **how: Any,
) -> ReportTable:
    """Measure coverage; see :meth:`sgstore.query.StoreVerbs.coverage`."""
    from sgstore.testsets import coverage as of

    one_of("kind", kind, KINDS)
    if by is None and kind in _COMPARING:
        raise ConfigError(f"the coverage {kind!r} needs frames to compare with: by=STORE")
    chosen = chosen_frames(store, "" if kind == "spec" else query, parameters)
    other = [] if by is None else [frames_at(by)]
    declared = None if slots is None else of.Specification.read(slots)
    asked = {"missing": missing, "covered": covered}
    if declared is not None and kind in {"spec", "combos"}:
        return listed(of.slot_coverage(chosen, declared, how["k"] * (kind == "combos")), **asked)
    if kind == "spec":
        return listed(of.specification(chosen, query, how["cells"], *other), **asked)
    if kind == "iso34502":
        return listed(of.iso34502(chosen), **asked)
    if kind == "sequences":
        named, within = of.manoeuvres_named(how["manoeuvres"]), seconds(how["within"], "--within")
        found = of.sequences(chosen, how["k"], other[0] if other else None, named, within)
        return listed(found, **asked)
    options = how["abstraction"], how["window"], how["incomplete"]
    both = [
        of.classed(one, *options, declared[0] if declared else None) for one in (chosen, *other)
    ]
    if kind == "combos":
        pairs = of.combos(both[0], options[0], how["k"], *both[1:], of_ego=how["of_ego"])
        return listed(pairs, **asked)
    options = {name: how[name] for name in ("items", "unit", "points", "by_frame", "depth")}
    tables = class_tables(kind, both, abstraction=how["abstraction"], **options)
    return tables[-1 if how["tree"] else 0]


def listed(found: Any, *, missing: bool, covered: bool) -> ReportTable:
    """Return one table of a coverage: the missing items, the covered items, or by default the shares.

    ``found``: the three tables shares, covered, missing; or an object with these attributes.
    """
    name = "missing" if missing else "covered" if covered else "shares"
    tables = ("shares", "covered", "missing")
    return found[tables.index(name)] if isinstance(found, tuple) else getattr(found, name)


def class_tables(  # noqa: PLR0913 - the options of the commands
    kind: str,
    classed: Sequence[Classed],
    *,
    items: str = "classes",
    unit: Any = "frame",
    points: int = 40,
    abstraction: str = "RSV",
    by_frame: bool = False,
    depth: int = 4,
) -> tuple[ReportTable, ...]:
    """Return tables of class coverage: features and a decision tree for ``explain``, otherwise one table.

    Parameters
    ----------
    kind : str
        ``classes``, ``growth``, ``of``, ``novel``, ``venn`` or ``explain``.
    classed : sequence of Classed
        Frames with their classes: one selection, or the two to compare.
    items, unit, points, abstraction, by_frame, depth
        As in :meth:`sgstore.query.StoreVerbs.coverage`.
    """
    from sgstore.testsets import coverage as of

    novel = {"classes": of.novel, "frames": of.novel_frames, "clips": of.novel_clips}
    chosen = novel[one_of("--items", items, novel)]
    if kind == "classes":
        return (of.classes(classed[0], unit),)
    if kind == "growth":
        return (of.growth(classed[0], unit, points),)
    if kind == "explain":
        return of.explain(classed[0], classed[1], abstraction, by_frame=by_frame, depth=depth)
    return ({"of": of.covered, "venn": of.venn, "novel": chosen}[kind](*classed),)


_COMPARING: Final = ("of", "novel", "venn", "explain")
KINDS: Final = ("classes", "growth", "combos", "sequences", "spec", "iso34502", *_COMPARING)
"""Kinds of coverage that can be measured."""


def diff(
    store: Store | Collection,
    *,
    other: Place,
    query: str,
    by_frame: bool,
    abstraction: str,
    parameters: Any,
) -> ReportTable:
    """Compare two stores; see :meth:`sgstore.query.StoreVerbs.diff`."""
    text, values = statement(query, parameters or {}, check=True) if query else ("", {})
    whole, than = chosen_frames(store, "", None), frames_at(other)
    return compared(whole, than, text, values, by_frame, abstraction)


def compared(
    a: ChosenFrames,
    b: ChosenFrames,
    text: str,
    values: Mapping[str, object],
    by_frame: bool,  # noqa: FBT001 - named by the callers
    abstraction: str,
) -> ReportTable:
    """Compare two selections of frames. Return different scenes, or different results of a statement."""
    from sgstore.testsets import diff as differences
    from sgstore.testsets.coverage import classed

    if text and by_frame:
        raise ConfigError("expected one of a query and --by-frame")
    if not text:
        compare = differences.by_frame if by_frame else differences.scenes
        return compare(*(classed(one, abstraction) for one in (a, b)))
    if any(one.frame_id is not None for one in (a, b)):
        raise ConfigError("a query compares whole stores; expected no STORE:QUERY and no lock")
    results = differences.verdicts if differences.has_checks(text) else differences.matches
    return results(a.store, b.store, text, values)


def timeline(
    store: Store | Collection,
    *,
    queries: Sequence[str],
    traces: Sequence[str],
    to: str | Path | None,
    parameters: Any,
) -> list[Timeline]:
    """Return timelines of matches and violations; see :meth:`sgstore.query.StoreVerbs.timeline`."""
    from sgstore.draw import draw_timelines, timelines

    found = timelines(one_store(store), by_lane(queries, parameters or {}), traces)
    if to is not None:
        draw_timelines(found, Path(to))
    return found


def by_lane(
    queries: Sequence[str], parameters: Mapping[str, Any], files: Mapping[str, str] | None = None
) -> dict[str, tuple[str, Mapping[str, object]]]:
    """For each lane of a timeline, return its query and the values of its parameters, by lane name.

    Parameters
    ----------
    queries : sequence of str
        Each is a statement, or the name of a pattern in the library.
    parameters : mapping
        Patterns of the library take the values of their own parameters; all others belong to the statements.
    files : mapping of str to str, optional
        More statements, by the name of their lane.

    Raises
    ------
    QueryError
        A name is unknown, or no statement has a parameter.
    """
    asked = list(dict.fromkeys(one.strip() for one in queries))
    named = {one: pattern_named(one) for one in asked if one.isidentifier()}
    rest = {
        name: value
        for name, value in parameters.items()
        if not any(name in one.parameters for one in named.values())
    }
    texts = [one for one in asked if one not in named]
    if rest and named and not (texts or files):
        next(iter(named.values())).written(**rest)  # raises an error with the known parameters
    found: dict[str, tuple[str, Mapping[str, object]]] = {}
    for one in asked:
        if one in named:
            lane = free_name(named[one].name, f"pattern {one}", found)
            own = {k: value for k, value in parameters.items() if k in named[one].parameters}
        else:
            lane = "match" if len(texts) == 1 else f"match {texts.index(one) + 1}"
            own = rest
        found[lane] = statement(one, own, check=True)
    for name, text in (files or {}).items():
        found[free_name(name, f"file {name}", found)] = statement(text, rest, check=True)
    return found


def free_name(name: str, longer: str, taken: Container[str]) -> str:
    """Return a free name: the short one, else the longer one, else the longer one with a number."""
    if name not in taken:
        return name
    numbered = (f"{longer} ({number})" for number in count(2))
    return next(one for one in chain([longer], numbered) if one not in taken)


def report(
    store: Store | Collection,
    *,
    query: str,
    to: str | Path,
    limit: int,
    around: str | float,
    pictures: bool,
    parameters: Any,
) -> tuple[int, bool]:
    """Write a page of matches; see :meth:`sgstore.query.StoreVerbs.report`."""
    from sgstore.apps.report import report as write

    text, values = statement(query, parameters or {})
    around_s, most = seconds(around, "--around"), limit or sys.maxsize
    opened, page = one_store(store), Path(to)
    return write(
        opened, text, page, parameters=values, most=most, around_s=around_s, pictures=pictures
    )


def export(  # noqa: PLR0913 - the options of the command
    store: Store | Collection,
    *,
    query: str,
    to: str | Path,
    form: str,
    frames: Sequence[str | int] | None,
    lock: str | Path | None,
    before: str | float,
    after: str | float,
    labels: Sequence[str],
    mounts: Sequence[str],
    channels: Sequence[str],
    parameters: Any,
    progress: Callable[[int, int], None] | None = None,
    on_matches: Callable[[Matches, Sequence[Clip]], None] | None = None,
    **same: Any,
) -> list[WrittenClip | WrittenFile]:
    """Export clips; see :meth:`sgstore.query.StoreVerbs.export`."""
    from sgstore.exporters import (
        Export,
        check_folder,
        exporter_named,
        labelled,
        parse_labels,
        parse_mounts,
        write_export,
    )

    exporter = exporter_named(form)  # before the search starts
    check_folder(Path(to))
    texts, margins = parse_labels(labels), (seconds(before, "--before"), seconds(after, "--after"))
    same |= {"mounts": parse_mounts(mounts), "channels": tuple(channels), "progress": progress}
    if sum((bool(query), frames is not None, lock is not None)) > 1:
        raise ConfigError("expected one of: a QUERY, --frames, --lock")
    opened, values = one_store(store), dict(parameters or {})
    text, held = statement(query, values) if query else ("", {})
    told = {"query": text} if query else {"lock": Path(lock).name} if lock else {}
    if lock is not None:
        from sgstore.testsets.locks import cases_of

        clips = [Clip(*case[:3]) for case in cases_of(lock, opened)]
    elif frames is not None:
        from sgstore.exporters import around_frames

        clips = around_frames(opened, frames, *margins)
    elif query:
        matches = opened.find(text, **held)
        clips = list(matches.clips(*margins))
        if on_matches is not None:
            on_matches(matches, clips)
    else:
        clips = _whole_clips(opened, exporter)
    if not clips:
        return []
    order = Export(opened, tuple(clips), provenance=told, **same)
    return write_export(labelled(order, texts, **(held if query else values)), to, form)


def _whole_clips(store: Store, exporter: Exporter) -> list[Clip]:
    from sgstore.exporters import whole_clips

    if exporter.recorded:
        raise ExportError(
            f"the format '{exporter.name}' copies recordings; add a query: 'MATCH (e:Ego)' is"
            " every frame with an ego"
        )
    return whole_clips(store)


def lock(
    store: Store | Collection | None,
    *,
    cases: Selection | Prioritized,
    to: str | Path | None,
    split: str,
    payloads: bool,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """Return a lock of test cases; see :meth:`sgstore.query.StoreVerbs.lock`."""
    from sgstore.testsets.selection import (
        Selection,
        locked_order,
        locked_selection,
        parse_split,
    )
    from sgstore.testsets.selection import split as split_up

    del store  # the cases have theirs
    chosen = cases.units.chosen
    about: dict[str, Any] = {"parameters": dict(chosen.parameters), "payloads": payloads}
    about |= {"progress": progress}
    if isinstance(cases, Selection):
        parts = split_up(cases, parse_split(split)) if split else {}
        made = locked_selection(cases, chosen.query, parts, **about)
    else:
        made = locked_order(cases, chosen.query, **about)
    if to is not None:
        made.write(to)
    return made


def verify(
    store: Store | Collection, *, lock: str | Path | None, payloads: bool | None, strict: bool
) -> list[Any]:
    """Verify a store, or that it has the cases of a lock; see :meth:`sgstore.query.StoreVerbs.verify`."""
    if lock is not None:
        from sgstore.testsets.locks import read_lock
        from sgstore.testsets.locks import verify as compare

        found = compare(read_lock(lock), store, payloads=payloads is not False)
        return [one for one in found if strict or one.matters]
    if isinstance(store, Store):
        from sgstore.store import verify_file

        return verify_file(store.file.path, recordings=bool(payloads)).faults
    from sgstore.collection import verify as verify_all

    return verify_all(store.place.url).faults
