"""Bound patterns → SQL, second phase: conditions and results that need values of single frames.

The frames that the first phase leaves are joined with ``state`` (and the tables of constants) for each node
whose values are asked for; numbers of pairs are computed around that join (:mod:`sgstore.lang.layers`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeGuard

from sgstore.lang.bound import (
    BlockValue,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    NodeAttribute,
    NodeValue,
    PairNumber,
    Scope,
    TraceAttribute,
    nodes_of,
)
from sgstore.lang.catalog import Home, Unit
from sgstore.lang.counting import folded, merged
from sgstore.lang.formulas import (
    Aliases,
    Leaf,
    Select,
    attribute_text,
    columns_of,
    edge_table,
    expression_text,
    frame_text,
    is_position,
    lane_text,
    leaves,
    nested,
    role_text,
)
from sgstore.lang.kinds import Profile, homes_of, kind_conditions
from sgstore.lang.lasting import HELD, is_lasting, join_lasting
from sgstore.lang.layers import Join, Layers, bounds, column_of, named
from sgstore.lang.pairs import WAY, way_text
from sgstore.lang.phases import Given, Phases, apart
from sgstore.lang.sql import Masks
from sgstore.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.lang.catalog import Attribute
    from sgstore.lang.results import Gathered

PATTERN: Final = '":pattern"'
FRAME: Final = '":frame"'
TRACE: Final = '":trace"'
MAP: Final = '":map"'


class Frames(Masks):
    """Writes relations of both phases for one query.

    Attributes
    ----------
    gathered : tuple of Gathered
        Tables that they speak of and the store has not.
    """

    gathered: tuple[Gathered, ...] = ()

    def frames(
        self,
        scope: Scope,
        given: Given | None,
        nodes: frozenset[str],
        edges: frozenset[str] = frozenset(),
        columns: Iterable[Leaf] = (),
    ) -> str:
        """The relation of the second phase: one row a frame and binding of some nodes and edges.

        Parameters
        ----------
        scope : Scope
        given : Given or None
            What binds the outer nodes.
        nodes, edges : frozenset of str
            What is to be bound; every binding comes once for each frame.
        columns : iterable of Leaf
            Values wanted beside them, each a column named by :func:`column_of`.
        """
        parts = self.phases(scope)
        wanted = list(dict.fromkeys(columns))
        if HELD in wanted and not (parts.rest or parts.late):
            return self._by_buckets(scope, parts, given, nodes, edges, wanted)
        conditions = [*parts.rest, *bounds(parts.rest)]
        needed = list(dict.fromkeys([*(leaf for c in conditions for leaf in leaves(c)), *wanted]))
        join = Join()
        bound = nodes | {key for leaf in needed for key in nodes_of(leaf)}
        bound |= self._ends(scope, needed)
        every = {*scope.nodes, *scope.outer}
        bound |= {key for pair in apart(scope, every, parts.late) for key in pair}
        ties = edges | {leaf.edge for leaf in needed if isinstance(leaf, EdgeRelation)}
        given = self._first_phase(join, scope, parts, given, bound, ties, needed)
        self._second_phase(join, scope, parts, given, needed)
        layers = Layers(join, needed, conditions)
        text = layers.text(self.values, columns_of(nodes, edges), wanted)
        told = {leaf.node for leaf in wanted if isinstance(leaf, NodeValue)}
        told |= {leaf.edge for leaf in wanted if isinstance(leaf, EdgeRelation)}
        told |= {leaf.node for leaf in wanted if _is_id(leaf)}
        hidden = (bound | parts.late | ties) - nodes - edges - told
        hidden -= {key for key in hidden - ties if scope.kinds(key).one_a_frame}
        return "SELECT DISTINCT" + text.removeprefix("SELECT") if hidden else text

    def _by_buckets(
        self,
        scope: Scope,
        parts: Phases,
        given: Given | None,
        nodes: frozenset[str],
        edges: frozenset[str],
        wanted: list[Leaf],
    ) -> str:
        """One row a bucket and binding, with the number of frames that it stands for."""
        select, texts = self._of_buckets(scope, parts, given, nodes, edges, wanted)
        texts[HELD] = self.held(PATTERN)
        columns = {column: f"{PATTERN}.{column}" for column in columns_of(nodes, edges)}
        columns |= {quoted(column_of(leaf)): texts[leaf] for leaf in wanted}
        select.columns = [named(text, name) for name, text in columns.items()]
        return select.text()

    def _of_buckets(
        self,
        scope: Scope,
        parts: Phases,
        given: Given | None,
        nodes: frozenset[str],
        edges: frozenset[str],
        wanted: Iterable[Leaf],
    ) -> tuple[Select, dict[Leaf, str]]:
        """What the first phase leaves, joined with what lasting values come from; how each is computed."""
        select = Select()
        select.join(nested(self.masks(scope, parts, given, nodes, edges), PATTERN[1:-1]), [])
        bound = {key: f"{PATTERN}.{quoted(f'{key}.id')}" for key in nodes}
        bucket = f'{PATTERN}."bucket"'
        texts = join_lasting(select, bucket, bound, scope, self.catalog, wanted)
        for leaf in wanted:
            if isinstance(leaf, EdgeRelation):
                texts[leaf] = f"CAST({PATTERN}.{quoted(f'{leaf.edge}.type')} AS VARCHAR)"
        return select, texts

    def in_masks(self, scope: Scope, wanted: Iterable[Leaf], values: Mapping[str, str]) -> str:
        """In which frames some match has which values: one row a bucket and combination of them.

        Parameters
        ----------
        scope : Scope
        wanted : iterable of Leaf
            What the values are made of.
        values : mapping of str to str
            Column, quoted → its text in terms of a relation ``":rows"`` that has the columns ``wanted``.
        """
        rows = self._lasting(scope, wanted)
        if rows is not None:
            return merged(rows, values)
        rows = self.frames(scope, None, frozenset(), frozenset(), wanted)
        select = Select(['"frame_id"'], [nested(rows, ":rows")])
        select.columns += [f"{text} AS {column}" for column, text in values.items()]
        return folded(select.text(), list(values))

    def _lasting(self, scope: Scope, wanted: Iterable[Leaf]) -> str | None:
        """One row a bucket and match, with values that last as long; ``None`` if frames must be looked at."""
        parts, wanted = self.phases(scope), list(dict.fromkeys(wanted))
        if parts.rest or parts.late or not all(is_lasting(v, scope, self.catalog) for v in wanted):
            return None
        nodes = frozenset(key for leaf in wanted for key in nodes_of(leaf))
        edges = frozenset(leaf.edge for leaf in wanted if isinstance(leaf, EdgeRelation))
        select, texts = self._of_buckets(scope, parts, None, nodes, edges, wanted)
        select.columns = self.in_which(PATTERN)
        select.columns += [named(texts[leaf], quoted(column_of(leaf))) for leaf in wanted]
        return select.text()

    def _ends(self, scope: Scope, needed: list[Leaf]) -> set[str]:
        """Nodes at the ends of edges whose attributes are needed."""
        keys = {leaf.edge for leaf in needed if isinstance(leaf, EdgeAttribute)}
        return {end for e in scope.edges if e.key in keys for end in (e.src, e.dst)}

    def _first_phase(
        self,
        join: Join,
        scope: Scope,
        parts: Phases,
        given: Given | None,
        bound: frozenset[str],
        ties: frozenset[str],
        needed: list[Leaf],
    ) -> Given | None:
        """What the first phase leaves, and its frames; what it gives to the blocks of the second."""
        if parts.empty:
            return None
        nodes = bound - parts.late
        text = self.masks(scope, parts, given, nodes, ties)
        blocks = [leaf for leaf in needed if isinstance(leaf, BlockValue)]
        if blocks:
            given = Given(self.share(text, "pattern"), nodes, ties)
            text = Select(["*"], [quoted(given.name)]).text()
        join.nodes |= {key: f"{PATTERN}.{quoted(f'{key}.id')}" for key in nodes}
        join.edges |= {key: f"{PATTERN}.{quoted(f'{key}.type')}" for key in ties}
        leader = self._leader(scope, parts, nodes, needed)
        if leader is None:
            join.select.join(nested(self.expanded(text, nodes, ties), PATTERN[1:-1]), [])
            join.frame = f'{PATTERN}."frame_id"'
        else:
            join.select.join(nested(text, PATTERN[1:-1]), [])
            self._join_leader(join, scope, leader)
        return given

    def _leader(
        self, scope: Scope, parts: Phases, nodes: frozenset[str], needed: list[Leaf]
    ) -> str | None:
        """The node whose states bring the frames with them, so that masks need not be expanded.

        The many states are then looked up in the few rows of the first phase, rather than these, one row a
        frame, among the states. Only where a query chooses traces it is better to say which frames are asked.
        """
        if parts.trace or (scope is self.query.scope and self.chooses_traces):
            return None
        moving = [
            key
            for key in sorted({key for leaf in needed for key in _valued(leaf)} & nodes)
            if Profile.of(scope.kinds(key), self.catalog).places == 1
            and Home.state in self._homes(scope, key, needed)
        ]
        others = [key for key in moving if scope.kinds(key).other]
        return next(iter(others or moving), None)

    def _join_leader(self, join: Join, scope: Scope, key: str) -> None:
        alias = quoted(key)
        frame = f'{alias}."frame_id"'
        on = [f'{frame} >> 6 = {PATTERN}."bucket"', f'{alias}."node_id" = {join.nodes[key]}']
        on += self._of_kinds(scope, key, alias)
        join.select.join(f'"state" AS {alias}', [*on, self.in_mask(PATTERN, frame)])
        join.select.where += self.within(frame, 64)
        join.frame = frame
        # Said of the bucket, so that constants are looked up for the rows of masks, and not for all states.
        join.trace = f'{PATTERN}."bucket" >> 18'
        join.at[key] = Aliases(state=alias)

    def _of_kinds(self, scope: Scope, key: str, state: str) -> list[str]:
        """Conditions that keep states to what a node may be; of the ego's states it is enough that they are."""
        if scope.kinds(key).one_a_frame and key not in self.phases(scope).late:
            return [f'{state}."is_ego"']
        return kind_conditions(
            scope.kinds(key), f'{state}."kind"', f'{state}."is_ego"', self.catalog.moving
        )

    def _homes(
        self, scope: Scope, key: str, needed: list[Leaf], *, stated: bool = False
    ) -> set[Home]:
        """Where the values of a node that are needed live; ``stated``: its state is joined anyway."""
        profile = Profile.of(scope.kinds(key), self.catalog)
        of_it = [leaf for leaf in needed if key in _valued(leaf)]
        homes = _homes(of_it, profile)
        if profile.places == 1 and profile.moving and (stated or Home.state in homes):
            # Its state says its kind as well, and so its name.
            homes = {Home.state} | _homes([leaf for leaf in of_it if not _of_kind(leaf)], profile)
        return homes

    def _second_phase(
        self, join: Join, scope: Scope, parts: Phases, given: Given | None, needed: list[Leaf]
    ) -> None:
        """Join whatever the values come from, and say how each is computed."""
        for key in sorted(parts.late):
            self._bind_late(join, scope, key)
        join.select.where += [
            f"{join.nodes[a]} <> {join.nodes[b]}"
            for a, b in apart(scope, set(join.nodes), parts.late)
        ]
        if parts.empty:
            join.select.where += self.of_traces(f"{join.frame} >> 24", scope)
        self._join_rows(join, scope, parts, needed)
        for key in sorted({key for leaf in needed for key in _valued(leaf)}):
            stated = key in join.at and join.at[key].state is not None
            homes = self._homes(scope, key, needed, stated=stated)
            self._join_values(join, scope, key, homes)
        for leaf in needed:
            self._say(join, scope, given, leaf)

    def _bind_late(self, join: Join, scope: Scope, key: str) -> None:
        """A node that is bound by its state in the frame."""
        alias = quoted(key)
        on = [f'{alias}."frame_id" = {join.frame}'] if join.frame else []
        on += self._of_kinds(scope, key, alias)
        join.select.join(f'"state" AS {alias}', on)
        join.select.where += self.within(f'{alias}."frame_id"', 64)
        join.frame = join.frame or f'{alias}."frame_id"'
        join.nodes[key] = f'{alias}."node_id"'
        join.at[key] = Aliases(state=alias)

    def _join_rows(self, join: Join, scope: Scope, parts: Phases, needed: list[Leaf]) -> None:
        """The rows of the frame, of its trace and of the map, where they are needed."""
        kinds = {type(leaf) for leaf in needed}
        on_map = any(
            Profile.of(scope.kinds(key), self.catalog).mapped
            for leaf in needed
            for key in _valued(leaf)
        )
        position = any(is_position(leaf) for leaf in needed)
        pairs_on_map = on_map and PairNumber in kinds
        trace = TraceAttribute in kinds or position or pairs_on_map
        since = any(_since_start(leaf) for leaf in needed)
        if on_map or trace or since or any(_of_frame(leaf) for leaf in needed):
            join.select.join(f'"frame" AS {FRAME}', [f'{FRAME}."frame_id" = {join.frame}'])
        if trace or since:
            on = [f'{TRACE}."trace_id" = {FRAME}."trace_id"']
            join.select.join(f'"trace" AS {TRACE}', on)
        if any(
            isinstance(leaf, TraceAttribute) and Home.map in leaf.attribute.columns
            for leaf in needed
        ):
            on = [f'{MAP}."map_id" = {TRACE}."map_id"']
            join.select.join(f'"map" AS {MAP}', on, "LEFT JOIN")

    def _join_values(self, join: Join, scope: Scope, key: str, homes: set[Home]) -> None:
        """The tables that some values of a node come from."""
        profile = Profile.of(scope.kinds(key), self.catalog)
        at, node = join.at.get(key, Aliases()), join.nodes[key]
        state, entity, part = at.state, None, None
        if Home.state in homes and state is None:
            state = quoted(key)
            on = [f'{state}."frame_id" = {join.frame}']
            if not scope.kinds(key).one_a_frame:  # one column filters the scan as it reads
                on.append(f'{state}."node_id" = {node}')
            on += self._of_kinds(scope, key, state) + self.within(f'{state}."frame_id"', 64)
            alone = profile.places == 1
            join.select.join(f'"state" AS {state}', on, "JOIN" if alone else "LEFT JOIN")
        if homes & {Home.entity, Home.scenery}:
            entity = quoted(f"{key}.entity")
            trace = join.trace or f"{join.frame} >> 24"
            on = [f'{entity}."trace_id" = {trace}', f'{entity}."node_id" = {node}']
            how = "LEFT JOIN" if profile.mapped else "JOIN"
            join.select.join(f'"entity" AS {entity}', on, how)
        if Home.map in homes:
            part = quoted(f"{key}.map")
            on = [f'{part}."map_id" = {FRAME}."map_id"', f'{part}."node_id" = {node}']
            how = "JOIN" if profile.places == 1 else "LEFT JOIN"
            join.select.join(f'"map_node" AS {part}', on, how)
        join.at[key] = Aliases(state, entity, part, TRACE)

    def _say(self, join: Join, scope: Scope, given: Given | None, leaf: Leaf) -> None:
        """How a value is computed; a block or the attributes of an edge are joined for it."""
        match leaf:
            case NodeValue(node=node):
                join.texts[leaf] = join.nodes[node]
            case NodeAttribute(node=node, attribute=attribute):
                join.texts[leaf] = self._of_node(join, node, attribute)
            case EdgeRelation(edge=edge):
                join.texts[leaf] = f"CAST({join.edges[edge]} AS VARCHAR)"
            case EdgeAttribute(edge=edge):
                join.texts[leaf] = self._of_lane(join, scope, edge, leaf)
            case FrameAttribute() if leaf is HELD:
                join.texts[leaf] = "1"
            case FrameAttribute() | TraceAttribute():
                join.texts[leaf] = frame_text(leaf, FRAME, TRACE, MAP)
            case BlockValue():
                join.texts[leaf] = self._of_block(join, given, leaf)
            case PairNumber(function=function, a=a, b=b):
                if function == WAY:  # the others are computed in layers
                    join.texts[leaf] = self._of_ways(join, scope, a, b)

    def _of_node(self, join: Join, node: str, attribute: Attribute) -> str:
        if attribute.unit is Unit.binding:
            return join.nodes[node]
        if attribute.unit is Unit.role:
            return role_text(join.frame, join.nodes[node])
        return attribute_text(attribute, join.at[node])

    def _of_lane(self, join: Join, scope: Scope, key: str, leaf: EdgeAttribute) -> str:
        alias = quoted(f"{key}:in")
        if alias not in join.lanes:
            join.lanes.add(alias)
            edge = next(edge for edge in scope.edges if edge.key == key)
            table, ends = edge_table(edge, join.nodes[edge.src], join.nodes[edge.dst])
            on = [f'{alias}."frame_id" = {join.frame}']
            on += [f"{alias}.{quoted(column)} = {node}" for column, node in ends.items()]
            join.select.join(f"{quoted(table)} AS {alias}", on, "LEFT JOIN")
        return lane_text(leaf, alias)

    def _of_ways(self, join: Join, scope: Scope, a: str, b: str) -> str:
        every = self.catalog.moving | self.catalog.fixed
        conditions = [
            condition
            for alias, key in (('"a"', a), ('"b"', b))
            for condition in kind_conditions(
                scope.kinds(key), f'{alias}."kind"', f'{alias}."is_ego"', every
            )
        ]
        return way_text(join.frame, join.nodes[a], join.nodes[b], conditions)

    def _of_block(self, join: Join, given: Given | None, leaf: BlockValue) -> str:
        """The value of a block for each frame and binding of the nodes outside."""
        keys = frozenset(leaf.scope.outer)
        alias = f":block {leaf.number}"
        rows = self._block_rows(leaf, given, keys)
        on = [f'{quoted(alias)}."frame_id" = {join.frame}']
        on += [
            f"{quoted(alias)}.{column} = {join.nodes[key]}"
            for key, column in zip(sorted(keys), columns_of(keys), strict=True)
        ]
        join.select.join(nested(rows, alias), on, "LEFT JOIN")
        value = f'{quoted(alias)}."value"'
        if leaf.word == "EXISTS":
            return f"coalesce({value}, FALSE)"
        return f"coalesce({value}, 0)" if leaf.word in {"COUNT", "SUM"} else value

    def _block_rows(self, leaf: BlockValue, given: Given | None, keys: frozenset[str]) -> str:
        if (
            leaf.word == "EXISTS"
        ):  # a column that is no key: DuckDB 2.0.0 errs where keys are tested for NULL
            rows = self.frames(leaf.scope, given, keys)
            return Select(["*", 'TRUE AS "value"'], [nested(rows, ":block")]).text()
        parts = list(leaves(leaf.value)) if leaf.value is not None else []
        select = Select(['"frame_id"', *columns_of(keys)])
        select.join(nested(self.counted(leaf, given, parts), ":counted"), [])
        select.group = list(select.columns)
        if leaf.value is None:
            select.columns.append('count(*) AS "value"')
        else:
            value = expression_text(leaf.value, lambda part: quoted(column_of(part)), self.values)
            select.columns.append(f'{leaf.word.lower()}({value}) AS "value"')
        return select.text()


def _is_id(leaf: Leaf) -> TypeGuard[NodeAttribute]:
    return isinstance(leaf, NodeAttribute) and leaf.attribute.unit is Unit.binding


def _valued(leaf: Leaf) -> frozenset[str]:
    """Nodes whose tables a value needs."""
    match leaf:
        case NodeAttribute(node=node, attribute=attribute):
            bare = attribute.unit in {Unit.binding, Unit.role}
            return frozenset() if bare else frozenset({node})
        case PairNumber(function=function, a=a, b=b):
            return frozenset() if function == WAY else frozenset({a, b})
        case _:
            return frozenset()


def _homes(needed: list[Leaf], profile: Profile) -> set[Home]:
    """Where values of a node live, of the places where the node may live."""
    homes: set[Home] = set()
    for leaf in needed:
        if isinstance(leaf, PairNumber):
            homes |= {Home.state, Home.scenery, Home.map}
        elif isinstance(leaf, NodeAttribute):
            homes |= homes_of(leaf.attribute, profile)
    return {home for home in homes if profile.has(home)}


def _of_kind(leaf: Leaf) -> bool:
    """Whether a value is made of the kind, and the id, of a node."""
    attribute = leaf.attribute if isinstance(leaf, NodeAttribute) else None
    return attribute is not None and (attribute.unit is Unit.label or attribute.name == "kind")


def _of_frame(leaf: Leaf) -> bool:
    return isinstance(leaf, FrameAttribute) and leaf is not HELD


def _since_start(leaf: Leaf) -> bool:
    return isinstance(leaf, FrameAttribute) and leaf.attribute.unit is Unit.seconds
