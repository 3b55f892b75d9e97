"""Registries of extensions (readers, relations, abstractions, exporters), also from other packages.

A registry lists the objects of this package by name and place. An object is loaded at its first use. Other
packages add objects as entry points of the same groups (``pyproject.toml``)::

    [project.entry-points."sgstore.relations"]
    besides = "my_package.besides:BESIDES"

Another package cannot take a name of this package.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from importlib.metadata import EntryPoint

    from sgstore.errors import SgstoreError


def entry_points(group: str) -> Iterable[EntryPoint]:
    """Return the Python entry points of a group, from all installed packages."""
    from importlib import metadata  # The search is slow, and most processes do not need it.

    return metadata.entry_points(group=group)


@dataclass(frozen=True, slots=True)
class Registry:
    """Registry of extensions of one kind. It finds those of sgstore, and those of other packages.

    Attributes
    ----------
    group : str
        Group of entry points.
    own : mapping
        Name → place of the object (``module:attribute``). The order matters.
    what : str
        Noun for one object in messages.
    """

    group: str
    own: Mapping[str, str]
    what: str
    _loaded: dict[str, Any] = field(default_factory=dict[str, Any], compare=False)

    def others(self) -> dict[str, EntryPoint]:
        """Return the entry points (extensions) of other packages by name."""
        found: dict[str, EntryPoint] = {}
        for entry in entry_points(self.group):
            if entry.name not in self.own:
                found.setdefault(entry.name, entry)
        return found

    def load(self, name: str) -> Any:
        """Import the extension of sgstore with the given name, and return it."""
        if name not in self._loaded:
            module, _, attribute = self.own[name].partition(":")
            self._loaded[name] = getattr(import_module(module), attribute)
        return self._loaded[name]

    def load_other(self, entry: EntryPoint, error: type[SgstoreError]) -> Any:
        """Return an extension of another package, after importing it.

        Raises
        ------
        SgstoreError
            The object cannot be loaded. The error has the given type.
        """
        try:
            return entry.load()
        except Exception as fault:  # an import can raise anything
            reason = f"the {self.what} {entry.name!r} ({entry.value}) cannot be loaded: {fault!r}"
            raise error(reason) from fault

    def every(self, error: type[SgstoreError]) -> Iterator[tuple[str, Any]]:
        """Yield name and object of all extensions: first those of sgstore, then those of other packages."""
        for name in self.own:
            yield name, self.load(name)
        for name, entry in self.others().items():
            yield name, self.load_other(entry, error)


def _in(package: str, **places: str) -> dict[str, str]:
    return {name: f"sgstore.{package}.{place}" for name, place in places.items()}


READERS: Final = Registry(
    "sgstore.readers",
    _in(
        "readers",
        sgstore="osi._recorded:RecordedTrace",
        osi="osi._trace:OsiTrace",
        carla="carla._trace:CarlaTrace",
        autoware="autoware._trace:AutowareTrace",
        foxglove="foxglove._trace:FoxgloveTrace",
        commonroad="commonroad._trace:CommonRoadTrace",
        sumo="sumo._trace:SumoTrace",
        carla_recorder="carla._recorder:CarlaRecorderTrace",
        av2="av2._trace:Av2Trace",
        py123d="py123d._trace:Py123dTrace",
    ),
    "flavour",
)
"""Readers of recordings by flavour, in the order in which they are tried."""

RELATIONS: Final = Registry(
    "sgstore.relations",
    _in(
        "graphs.relations",
        isIn="_lanes:IS_IN",
        travelsTo="_map:TRAVELS_TO",
        laneChange="_map:LANE_CHANGE",
        opposes="_map:OPPOSES",
        toLeftOf="_bearing:TO_LEFT_OF",
        toRightOf="_bearing:TO_RIGHT_OF",
        conflictsWith="_map:CONFLICTS_WITH",
        controlsTrafficOf="_lanes:CONTROLS_TRAFFIC_OF",
        mayAffect="_lanes:MAY_AFFECT",
        safety_hazard="_proximity:SAFETY_HAZARD",
        near_coll="_proximity:NEAR_COLL",
        super_near="_proximity:SUPER_NEAR",
        very_near="_proximity:VERY_NEAR",
        near="_proximity:NEAR",
        visible="_proximity:VISIBLE",
        inDFrontOf="_bearing:IN_DIRECT_FRONT_OF",
        inSFrontOf="_bearing:IN_SIDE_FRONT_OF",
        atSRearOf="_bearing:AT_SIDE_REAR_OF",
        atDRearOf="_bearing:AT_DIRECT_REAR_OF",
        leads="_following:LEADS",
        follows="_following:FOLLOWS",
        overlaps="_contact:OVERLAPS",
        sees="_sight:SEES",
        tows="_hitches:TOWS",
    ),
    "relation",
)
"""Built-in relations by name. The first 24 have the order of ``schema.sql``; new relations come after them."""

ABSTRACTIONS: Final = Registry(
    "sgstore.abstractions",
    _in(
        "graphs.abstractions",
        E="_literature:entities",
        EL="_literature:in_lanes",
        ER="_literature:related",
        RSV="_literature:road_scene",
        RSV_related="_literature:related_scene",
        RSV_curvature="_literature:curved_scene",
        junction="_literature:junction",
        SG="_literature:whole",
        roadscene2vec="_literature:roadscene2vec",
    ),
    "abstraction",
)
"""Built-in abstractions by name. They are functions from graphs in columns to labelled graphs."""

EXPORTERS: Final = Registry("sgstore.exporters", {}, "format")
"""Export formats of other packages. :data:`sgstore.exporters.EXPORTERS` has those of this package."""

_VERBS: Final = (
    *("select", "prioritize", "criticality", "coverage", "diff"),
    *("timeline", "report", "export", "lock", "verify"),
)
VERBS: Final = Registry(
    "sgstore.verbs", _in("apps", **{name: f"verbs:{name}" for name in _VERBS}), "verb"
)
"""Functions behind methods of :class:`sgstore.query.StoreVerbs`, in packages of higher layers."""
