"""Where nodes are present and what is asked of them alone: as masks, a relation for each place they live in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.lang.bound import NodeAttribute
from sgstore.lang.catalog import Home
from sgstore.lang.formulas import (
    Aliases,
    Select,
    Values,
    is_position,
    leaves,
    node_text,
)
from sgstore.lang.kinds import homes_of, kind_conditions
from sgstore.vocabulary import ENTITY_KINDS

if TYPE_CHECKING:
    from sgstore.lang.bound import Bound, Kinds
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.kinds import Profile
    from sgstore.lang.phases import Window

_ENTITIES: Final = frozenset(ENTITY_KINDS)
_BIT: Final = '"bit"'


class Presence:
    """Writes relations of nodes, with the columns ``bucket``, ``node_id`` and ``mask``.

    Parameters
    ----------
    catalog : Catalog
    window : Window or None
        The buckets to look at; ``None``: all.
    """

    def __init__(self, catalog: Catalog, window: Window | None = None) -> None:
        self.catalog = catalog
        self.window = window
        self.values = Values()

    @property
    def standing(self) -> frozenset[str]:
        """Kinds of what is present by masks: static entities and parts of the map."""
        return self.catalog.fixed | self.catalog.mapped

    def within(self, column: str, per: int = 1) -> list[str]:
        """Conditions that keep a column of buckets, or of frames (``per`` 64), in the window."""
        if self.window is None:
            return []
        low, high = self.window.low * per, self.window.high * per
        return [f"{column} >= {low}", f"{column} < {high}"]

    def present(self, kinds: Kinds, profile: Profile, conditions: list[Bound]) -> str:
        """Frames in which nodes are present and meet conditions, for each place where they may live."""
        branches: list[str] = []
        if (
            profile.moving
            and not conditions
            and not kinds.other
            and profile.moving >= (self.catalog.moving & _ENTITIES)
        ):
            branches.append(self._ego())
        elif profile.moving:
            branches.append(self._moving(kinds, profile, conditions))
        if profile.fixed:
            branches.append(self._standing(kinds.only(profile.fixed), conditions, "fixed"))
        if profile.mapped:
            branches.append(self._standing(kinds.only(profile.mapped), conditions, "mapped"))
        return "\nUNION ALL\n".join(branches)

    def _ego(self) -> str:
        select = Select(['"bucket"', '"ego" AS "node_id"', f'bit_or({bit_of(_BIT)}) AS "mask"'])
        select.join('"frame"', ['"ego" IS NOT NULL', *self.within('"bucket"')])
        select.group = ['"bucket"', '"ego"']
        return select.text()

    def _moving(self, kinds: Kinds, profile: Profile, conditions: list[Bound]) -> str:
        frame, node = '"s"."frame_id"', '"s"."node_id"'
        select = Select(
            [f'{frame} >> 6 AS "bucket"', node, f'bit_or({bit_of(frame)}) AS "mask"'],
            group=[f"{frame} >> 6", node],
        )
        select.join(
            '"state" AS "s"',
            kind_conditions(kinds, '"s"."kind"', '"s"."is_ego"', self.catalog.moving),
        )
        select.where += self.within(frame, 64)
        found = [leaf for c in conditions for leaf in leaves(c) if isinstance(leaf, NodeAttribute)]
        homes = {home for leaf in found for home in homes_of(leaf.attribute, profile)}
        entity = '"n"' if Home.entity in homes else None
        if entity:
            on = [f'"n"."trace_id" = {frame} >> 24', f'"n"."node_id" = {node}']
            select.join('"entity" AS "n"', on)
        at = Aliases('"s"', entity, None, self._join_trace(select, f"{frame} >> 24", conditions))
        select.where += [node_text(c, node, at, self.values) for c in conditions]
        return select.text()

    def _standing(self, kinds: Kinds, conditions: list[Bound], place: str) -> str:
        bucket, node = '"p"."bucket"', '"p"."node_id"'
        select = Select([bucket, node, '"p"."mask"'])
        select.join('"node" AS "p"', kind_conditions(kinds, '"p"."kind"', None, self.standing))
        select.where += [f"{node} {'>=' if place == 'fixed' else '<'} 0", *self.within(bucket)]
        at = Aliases()
        if conditions and place == "fixed":
            on = [f'"n"."trace_id" = {bucket} >> 18', f'"n"."node_id" = {node}']
            select.join('"entity" AS "n"', on)
            trace = self._join_trace(select, f"{bucket} >> 18", conditions)
            at = Aliases(entity='"n"', trace=trace)
        elif conditions:
            select.join('"bucket" AS "b"', [f'"b"."bucket" = {bucket}'])
            on = ['"n"."map_id" = "b"."map_id"', f'"n"."node_id" = {node}']
            select.join('"map_node" AS "n"', on)
            at = Aliases(map='"n"')
        select.where += [node_text(c, node, at, self.values) for c in conditions]
        return select.text()

    def _join_trace(self, select: Select, trace: str, conditions: list[Bound]) -> str | None:
        """The row of the trace, if a condition is on a position, which is stored about the trace's origin."""
        if not any(is_position(leaf) for c in conditions for leaf in leaves(c)):
            return None
        select.join('"trace" AS "t"', [f'"t"."trace_id" = {trace}'])
        return '"t"'


def bit_of(frame: str) -> str:
    """The mask of a single frame, given its id or its number in the bucket."""
    number = frame if frame == _BIT else f"{frame} & 63"
    return f"CAST(1 AS BIGINT) << CAST({number} AS INTEGER)"
