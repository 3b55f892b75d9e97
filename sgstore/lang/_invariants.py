"""Values that a binding has for a whole bucket: constants of entities, of parts of the map, and of traces.

Results that are made of nothing else need no single frames; how often they count is the number of frames that
a mask holds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.lang._catalog import Attribute, DisplayUnit, Home, Type
from sgstore.lang._formulas import (
    Aliases,
    Select,
    attribute_text,
    frame_text,
    is_constant,
    owner_text,
)
from sgstore.lang._kinds import Profile
from sgstore.lang.ir import EdgeRelation, FrameAttribute, NodeAttribute, NodeValue, TraceAttribute
from sgstore.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.lang._catalog import Catalog
    from sgstore.lang._formulas import Leaf
    from sgstore.lang.ir import Scope


INVARIANT: Final = FrameAttribute(
    Attribute("held", Type.number, {}, "how many frames a row stands for"), Type.number
)
"""What counts of matches add up where a row may stand for many frames."""

_TRACE: Final = '":trace"'
_BUCKET: Final = '":bucket"'
_MAP: Final = '":map"'


def is_lasting(leaf: Leaf, scope: Scope, catalog: Catalog) -> bool:
    """Tell whether a value is the same in all frames of a bucket in which its binding holds."""
    match leaf:
        case NodeValue() | EdgeRelation() | TraceAttribute():
            return True
        case NodeAttribute(node=node, attribute=attribute):
            if attribute.unit in {DisplayUnit.binding, DisplayUnit.owner} or is_constant(leaf):
                return True
            profile = Profile.of(scope.kinds(node), catalog)
            if attribute.unit is DisplayUnit.role:
                return False
            return not profile.moving and not profile.fixed
        case _:
            return False


def join_lasting(
    select: Select,
    bucket: str,
    nodes: Mapping[str, str],
    scope: Scope,
    catalog: Catalog,
    needed: Iterable[Leaf],
) -> dict[Leaf, str]:
    """Join what lasting values come from to a relation of buckets; how each value is computed.

    Parameters
    ----------
    select : Select
    bucket : str
        The column of the bucket.
    nodes : mapping of str to str
        Node → the column that binds it.
    scope : Scope
    catalog : Catalog
    needed : iterable of Leaf
        Values of nodes and of the trace.
    """
    needed = list(needed)
    trace = f"{bucket} >> 18"
    _join_trace(select, trace, [leaf for leaf in needed if isinstance(leaf, TraceAttribute)])
    of_nodes = [leaf for leaf in needed if isinstance(leaf, NodeAttribute)]
    of_nodes = [leaf for leaf in of_nodes if leaf.attribute.unit is not DisplayUnit.binding]
    profiles = {leaf.node: Profile.of(scope.kinds(leaf.node), catalog) for leaf in of_nodes}
    if any(profile.mapped for profile in profiles.values()):
        select.join(f'"bucket" AS {_BUCKET}', [f'{_BUCKET}."bucket" = {bucket}'])
    owned = [leaf for leaf in of_nodes if leaf.attribute.unit is DisplayUnit.owner]
    texts: dict[Leaf, str] = {
        leaf: owner_text(nodes[leaf.node], profiles[leaf.node], trace, f'{_BUCKET}."map_id"')
        for leaf in owned
    }
    of_nodes = [leaf for leaf in of_nodes if leaf not in texts]
    profiles = {key: profiles[key] for key in {leaf.node for leaf in of_nodes}}
    at: dict[str, Aliases] = {}
    for key, profile in sorted(profiles.items()):
        entity = part = None
        if profile.moving or profile.fixed:
            entity = quoted(f"{key}.entity")
            on = [f'{entity}."trace_id" = {trace}', f'{entity}."node_id" = {nodes[key]}']
            select.join(f'"entity" AS {entity}', on, "LEFT JOIN" if profile.mapped else "JOIN")
        if profile.mapped:
            part = quoted(f"{key}.map")
            on = [f'{part}."map_id" = {_BUCKET}."map_id"', f'{part}."node_id" = {nodes[key]}']
            select.join(f'"map_node" AS {part}', on, "LEFT JOIN" if entity else "JOIN")
        at[key] = Aliases(entity=entity, map=part)
    texts |= {leaf: attribute_text(leaf.attribute, at[leaf.node]) for leaf in of_nodes}
    for leaf in needed:
        match leaf:
            case TraceAttribute():
                texts[leaf] = frame_text(leaf, "", _TRACE, _MAP)
            case NodeValue(node=node) | NodeAttribute(node=node) if leaf not in texts:
                texts[leaf] = nodes[node]
            case _:
                pass
    return texts


def _join_trace(select: Select, trace: str, needed: list[TraceAttribute]) -> None:
    if needed:
        select.join(f'"trace" AS {_TRACE}', [f'{_TRACE}."trace_id" = {trace}'])
    if any(Home.map in leaf.attribute.columns for leaf in needed):
        on = [f'{_MAP}."map_id" = {_TRACE}."map_id"']
        select.join(f'"map" AS {_MAP}', on, "LEFT JOIN")
