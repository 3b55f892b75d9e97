"""Derived sets of relations: computed from the states in a store, without its recordings."""

from __future__ import annotations

import hashlib
import shlex
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import AbstractionError, ConfigError
from sgstore.graphs.abstractions import SUBSETS, abstraction_named, abstractions, check_name
from sgstore.graphs.relations import Crowds
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import is_lane_text, read_lane_text
from sgstore.model.config import Config, from_dict
from sgstore.model.vocabulary import KINDS, RELATION_CODE, RELATIONS, kinds_labelled, normalize_name
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.model.config import RangeSettings
    from sgstore.store import StoredTrace


_ASIDE: Final = 10.0
"""Largest distance between the ego and the start of the line of its corridor; m."""

_NOT_RELATIONS: Final = ("ego", "egos", "payloads", "mapping", "rate")
"""Settings for reading a recording. They do not concern relations, so those of the ingest stay valid."""


@dataclass(frozen=True, slots=True)
class Derivation:
    """Result of deriving relations for one trace.

    Attributes
    ----------
    trace : str
        Its name.
    status : str
        ``derived``; ``present``: the store already had this set with the same settings.
    frames, edges : int
        Number of derived frames and edges; an edge counts in every frame. 0 for ``present``.
    losses : list of str
        Parts that could not be derived.
    """

    trace: str
    status: str
    frames: int = 0
    edges: int = 0
    losses: list[str] = field(default_factory=list[str])


def derive(
    store: str | Path,
    config: Config,
    name: str,
    traces: Sequence[int | str] = (),
    *,
    replace_old: bool = False,
) -> list[Derivation]:
    """Compute another set of relations from the stored states, and store it under a name.

    The set equals an ingest with these settings: the same edges, and the same range. The recordings are not
    read. Each trace is one transaction, so a stopped run can continue.

    Parameters
    ----------
    store : str or Path
    config : Config
        Its relations and range apply. The settings of the reading (egos, payloads, rate) stay as ingested.
    name : str
        Name of the set, for ``USING ABSTRACTION``.
    traces : sequence, optional
        Names or ids. Default: all traces.
    replace_old : bool
        Replace a set of this name with other settings.

    Returns
    -------
    list of Derivation
        One for each trace.

    Raises
    ------
    AbstractionError
        The name is invalid, is the name of an abstraction, or belongs to a set with other settings.
    ConfigError
        The settings need data that the store lacks: a larger range, other kinds, finer lanes.
    StoreError
        The store or a trace does not exist, or another process locks the store for too long.
    """
    check_name(name)
    if normalize_name(name) in abstractions():
        raise AbstractionError(f"{name!r} is the name of an abstraction; choose another")
    file, chosen = _chosen(store, traces)
    sets = file.deriving.sets()
    alike = [one for one in sets if normalize_name(one.name) == normalize_name(name)]
    known = {one.trace_id: one for one in alike}
    of_name = alike[0].name if alike else name
    plans = [(trace, _settings(trace, config)) for trace in chosen]
    results: list[Derivation] = []
    for trace, settings in plans:
        digest = _digest(settings)
        old = known.get(trace.trace_id)
        if old is not None and old.digest == digest:
            results.append(Derivation(trace.name, "present"))
            continue
        if old is not None and not replace_old:
            raise AbstractionError(
                f"{trace.name!r} has a set {old.name!r} already, with other settings;"
                " add --force to replace it, or choose another name"
            )
        results.append(_derived(file, trace, settings, of_name))
    return results


def keep_abstraction(
    store: str | Path, name: str, traces: Sequence[int | str] = ()
) -> list[Derivation]:
    """Store an abstraction's graph of each frame as a named set of relations, for use in queries.

    This works for ``roadscene2vec`` and for a client's own function. The set contains nodes of the scene graph,
    and edges labelled with relations. Artificial nodes and other labels are only in ``graph(frame,
    abstraction=…)``.

    Parameters
    ----------
    store, traces
        As in :func:`derive`.
    name : str
        Name of the abstraction and of the set.

    Returns
    -------
    list of Derivation
        One for each trace.

    Raises
    ------
    AbstractionError
        The abstraction does not exist, or queries can already use it.
    StoreError
        The store or a trace does not exist, or another process locks the store for too long.
    """
    abstraction = abstraction_named(name)
    if abstraction.name in SUBSETS:
        query = f"USING ABSTRACTION {abstraction.name} MATCH (e:Ego)"
        raise AbstractionError(
            f"queries use the abstraction {abstraction.name!r} without a derived set; write:"
            f" {shlex.join(['sgstore', 'find', str(store), query])}"
        )
    file, chosen = _chosen(store, traces)
    known = {(one.name, one.trace_id) for one in file.deriving.sets()}
    results: list[Derivation] = []
    for trace in chosen:
        if (abstraction.name, trace.trace_id) in known:
            results.append(Derivation(trace.name, "present"))
            continue
        frames = edges = 0
        relations: set[int] = set()
        with file.deriving.building(abstraction.name, trace.trace_id) as building:
            for seq, seen in file.deriving.seen(trace.trace_id):
                graphs = abstraction.function(seen)
                building.append_labelled(seq, seen, graphs)
                relations |= {
                    RELATION_CODE[text] for text in graphs.labels if text in RELATION_CODE
                }
                frames, edges = frames + graphs.frames, edges + len(graphs.related()[0])
            answers = tuple(RELATIONS[code] for code in sorted(relations))
            settings = {"abstraction": abstraction.name}
            building.publish(settings, hashlib.sha256(repr(settings).encode()).hexdigest(), answers)
        results.append(Derivation(trace.name, "derived", frames, edges))
    return results


def _chosen(
    store: str | Path, traces: Sequence[int | str]
) -> tuple[StoreFile, Sequence[StoredTrace]]:
    file = StoreFile(store)
    file.settle()
    return file, [file.trace(ref) for ref in traces] if traces else file.traces()


def _derived(file: StoreFile, trace: StoredTrace, config: Config, name: str) -> Derivation:
    graphs = replace(config, range=replace(config.range, world=0.0))
    generator, crowds = SceneGraphGenerator(_road_map(file, trace, graphs), graphs), Crowds()
    frames = edges = 0
    with file.deriving.building(name, trace.trace_id) as building:
        for block in file.deriving.blocks(trace.trace_id):
            for piece in generator.pieces(block):
                graph = generator.block(piece)
                building.append(graph)
                crowds.see(graph)
                frames += len(graph)
                edges += len(graph.edges)
        building.publish(config.as_stored(), _digest(config), generator.answers)
    losses = [loss.reason for loss in crowds.losses(config)]
    return Derivation(trace.name, "derived", frames, edges, losses)


def _road_map(file: StoreFile, trace: StoredTrace, config: Config) -> RoadMap | None:
    found = file.road_map_text(trace.trace_id)
    if found is None:
        return None
    name, text = found
    return read_lane_text(text, name) if is_lane_text(text) else read_map(text, name, config.signs)


def _digest(config: Config) -> str:
    return hashlib.sha256(repr(config.as_stored()).encode()).hexdigest()


def _settings(trace: StoredTrace, wanted: Config) -> Config:
    """Return the settings for deriving a trace's relations. Raise an error if stored states do not suffice.

    Raises
    ------
    ConfigError
        The stored states do not suffice.
    """
    if "imported" in trace.report:
        raise ConfigError(
            f"{trace.name!r} was imported as graphs; graphs cannot be derived without geometry"
        )
    old = from_dict(trace.settings)
    new = replace(wanted, **{name: getattr(old, name) for name in _NOT_RELATIONS})
    new = replace(new, range=replace(new.range, world=old.range.world))

    def need(holds: bool, setting: str, was: object, asked: object) -> None:  # noqa: FBT001
        if not holds:
            raise ConfigError(
                f"setting '{setting}' is {asked!r}, and {trace.name!r} was ingested with {was!r}:"
                " what that leaves out is not in the store; ingest the recording anew"
            )

    known = [old.range, *filter(None, [old.range.beyond()])]
    covered = any(_covers(one, new.range) for one in known)
    need(covered, "range", _shown(known[-1]), _shown(new.range))
    need(_kinds(new) <= _kinds(old), "kinds", old.kinds, new.kinds)
    need(dict(new.types) == dict(old.types), "types", dict(old.types), dict(new.types))
    lanes = new.lanes.granularity in {"none", old.lanes.granularity}
    need(lanes, "lanes.granularity", old.lanes.granularity, new.lanes.granularity)
    for name in ("sections", "spacing"):
        was, asked = getattr(old.lanes, name), getattr(new.lanes, name)
        need(was == asked, f"lanes.{name}", was, asked)
    fewer = not old.lanes.types or (
        bool(new.lanes.types)
        and {*map(str.lower, new.lanes.types)} <= {*map(str.lower, old.lanes.types)}
    )
    need(fewer, "lanes.types", old.lanes.types, new.lanes.types)
    return new


def _kinds(config: Config) -> set[str]:
    if not config.kinds:
        return set(KINDS)
    return {kind for label in config.kinds for kind in kinds_labelled(label) or ()}


def _shown(settings: RangeSettings) -> dict[str, Any]:
    """Return the settings that define the area around the ego: radius, shape and height limits."""
    of_shape = {
        "radius": ("radius",),
        "rectangle": ("front", "rear", "side"),
        "polygon": ("polygon",),
        "corridor": ("length", "width"),
    }
    names = ("shape", *of_shape[settings.shape], "by", "static_by")
    names += ("height", "grade", "height_of_entities") if settings.height else ()
    return {name: getattr(settings, name) for name in names}


def _covers(old: RangeSettings, new: RangeSettings) -> bool:
    """True if the old area around the ego surely contains the new one, in the plane and in height."""
    if _shown(old) == _shown(new):
        return True
    for name in ("by", "static_by"):
        if getattr(old, name) == "centre" and getattr(new, name) != "centre":
            return False
    band = ("height", "grade", "height_of_entities")
    if old.height and any(getattr(old, name) != getattr(new, name) for name in band):
        return False
    return _reaches(old, new)


def _reaches(old: RangeSettings, new: RangeSettings) -> bool:
    """True if the old area around the ego contains the new one. Heights are not compared."""
    if old.shape == new.shape == "corridor":
        return new.length <= old.length and new.width <= old.width
    if old.shape == "polygon":
        return new.shape == "polygon" and old.polygon == new.polygon
    if old.shape == "corridor":
        return False
    corners: Sequence[Sequence[float]] = new.polygon
    if new.shape in {"corridor", "radius"}:
        round_ = new.shape == "radius"
        reach = new.radius if round_ else new.length + new.width + _ASIDE
        corners = ((reach, 0.0), (-reach, 0.0), (0.0, reach), (0.0, -reach))
    elif new.shape == "rectangle":
        corners = list(product((new.front, -new.rear), (new.side, -new.side)))
    if old.shape == "radius":
        return all(ahead * ahead + left * left <= old.radius**2 for ahead, left in corners)
    return all(-old.rear <= a <= old.front and abs(left) <= old.side for a, left in corners)
