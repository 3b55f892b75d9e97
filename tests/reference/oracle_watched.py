"""Recordings watched as if they were live, against stores of them: ``python oracle_watched.py FOLDER ...``.

Every recording under the folders is driven frame by frame through monitors, and ingested: verdicts, violations,
witnesses, and what each pattern of the library finds, must be the same.
"""

from __future__ import annotations

import math
import re
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thorough import some

from sgstore.apps.demo import RECORDING
from sgstore.errors import SgstoreError
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.model.config import Config
from sgstore.model.pair_numbers import WAYS
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.temporal import Monitor, opened

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.matches import Interval
    from sgstore.model.graph import SceneGraph
    from sgstore.temporal import MonitorEvent, Verdict

CHECKS = """
CHECK apart: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) < 8 RESET WHEN dist(ego, v) > 9;
CHECK faster: FORSOME (v:Vehicle) EVENTUALLY (v.speed > 8 AND prev(v.speed) <= 8);
CHECK met: FORALL (b:Bus|Truck) FORSOME (p:Person) EVENTUALLY dist(b, p) < 20;
CHECK turning: FORALL (v:Vehicle WHERE v.speed > 5)
  ALWAYS (delta(v.heading, 1s) < 20 OR run_length(v.speed < 3) < 2s)
  RESET WHEN age(v) > 3 AND since_true(v.speed > 1) < 1s;
CHECK steady: FORALL (v:Vehicle)
  ALWAYS (max_over(v.speed, 1s) - min_over(v.speed, 5frames) < 3 OR avg_over(dist(ego, v), 2s) > 30)
  RESET WHEN sum_over(v.accel, 1s) > 0;
CHECK fast: FORALL (v:Vehicle) EVENTUALLY v.speed > 10;
CHECK lately: FORALL (v:Vehicle ABSENT AS TRUE) ALWAYS ONCE[0s, 5s] v.speed > 1;
CHECK stops: ALWAYS (ego.speed > 1 IMPLIES EVENTUALLY[0s, 3s] ego.speed < 1) AND ALWAYS ego.speed < 9;
USING END pending CHECK due: EVENTUALLY ego.speed > 40;
USING END weak CHECK forgiven: EVENTUALLY ego.speed > 40;
CHECK touches: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) < 8 RESET WHEN dist(ego, v) > 9
  RETURN MIN(dist(ego, v)) OVER match AS least, v.speed AS speed HAVING least < 5 AND speed < 6;
CHECK bursts: ALWAYS ego.speed < 5 RESET WHEN ego.speed < 4.5
  RETURN ego.speed AS speed HAVING LAST(frame.t) OVER match - FIRST(frame.t) OVER match > 2
"""

LANE_RULES = """
CHECK led: FORALL (v:Vehicle) ALWAYS NOT lead(ego, v);
CHECK some_led: FORSOME (v:Vehicle) EVENTUALLY lead(ego, v);
CHECK leads: FORALL (v:Vehicle) ALWAYS (lead(ego, v) IMPLIES gap(ego, v) < 30);
CHECK unled: FORALL (v:Vehicle) EVENTUALLY NOT EXISTS {(w:Vehicle)-[:leads]->(v)};
CHECK followed: FORALL (v:Vehicle) ALWAYS COUNT {(w:Vehicle)-[:follows]->(v)} < 1;
CHECK chain: FORALL (v:Vehicle) ALWAYS NOT EXISTS {(v)-[:follows*1..2]->(w:Vehicle) WHERE w.speed < 1};
CHECK left: FORALL (v:Vehicle) ALWAYS NOT turning_left(v);
CHECK right: FORALL (v:Vehicle) ALWAYS NOT turning_right(v);
CHECK straight: FORALL (v:Vehicle) ALWAYS NOT going_straight(v);
CHECK one_lane: FORALL (v:Vehicle) ALWAYS COUNT {(v)-[at:isIn {primary: TRUE}]->(l:Lane)} < 1;
CHECK own: FORALL (v:Vehicle) ALWAYS COUNT {(v)-[at:isIn {is_own: TRUE}]->(l:Lane)} = 1;
CHECK ways: FORALL (v:Vehicle) ALWAYS NOT lane_dist(ego, v) > 20;
CHECK ttc_lane: FORALL (v:Vehicle) ALWAYS NOT ttc_lane(ego, v) < 2;
CHECK junction: FORALL (v:Vehicle) ALWAYS to_junction(v) < 100;
CHECK any_junction: FORALL (v:Vehicle) ALWAYS coalesce(to_junction(v), 500) < 190;
CHECK no_way: FORALL (v:Vehicle) ALWAYS NOT lane_dist(ego, v) IS NULL;
CHECK curved: FORALL (v:Vehicle) ALWAYS abs(curvature(v)) < 0.05;
CHECK same: FORALL (v:Vehicle) ALWAYS NOT same_lane(ego, v);
CHECK red: FORALL (v:Vehicle) ALWAYS NOT red_for(v);
CHECK lasting: FORALL (v:Vehicle) ALWAYS NOT run_length(lead(ego, v)) > 2;
CHECK lacking: FORALL (v:Vehicle) ALWAYS NOT run_length(NOT lead(ego, v)) > 1;
CHECK growing: FORALL (v:Vehicle) ALWAYS NOT delta(lane_dist(ego, v), 1s) > 6;
CHECK gap: ALWAYS MAX {(v:Vehicle)-[g:leads]->(w:Vehicle) | g.gap} < 40
"""
"""Rules about lanes that vehicles drive: online, they may be unknown in junctions."""

VALUES = (
    "MATCH (e:Ego) WHERE e.speed > 5 AS a THEN MATCH (e) WHERE e.speed < 1 AS b RETURN t(b) - t(a) AS s,"
    " MIN(e.accel) OVER match, ARGMAX(e.speed) OVER a..b, AVG(e.speed) OVER a, e.speed - MAX(e.speed) OVER b",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 12 RETURN MIN(dist(e, v)) OVER match,"
    " FIRST(v.speed) OVER match, ARGMIN(dist(e, v), v.kind) OVER match, SUM(delta(v.x, 1s)) OVER match",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 15 FOR >= 1s AS a"
    " THEN WITHIN 3s MATCH (v) WHERE v.speed < 3 FOR >= 0.5s AS b"
    " RETURN MIN(ttc(e, v)) OVER match, LAST(dist(e, v)) OVER match, MAX(v.speed) OVER a, MIN(v.speed) OVER b,"
    " LAST(frame.seq) OVER b",
    "MATCH (e:Ego) WHERE e.speed < 1 AS a THEN NOT MATCH (e) WHERE e.speed > 8"
    " THEN MATCH (p:Person) WHERE p.speed > 1 AND EVENTUALLY[0s, 1s] p.speed < 1 AS b"
    " RETURN MIN(dist(e, p)) OVER match, FIRST(dist(e, p)) OVER a..b, AVG(coalesce(prev(p.speed), 0)) OVER b",
    "USING MATCHES longest MATCH (e:Ego) WHERE e.speed < 3 AS a UNTIL MATCH (e) WHERE e.speed > 2 AS b"
    " RETURN MAX(run_length(e.speed < 3)) OVER a, t(a) + MIN(e.speed) OVER b",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 12"
    " RETURN INTERVALS, MIN(dist(e, v)) OVER match AS least HAVING least < 7",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 15 FOR >= 1s AS a"
    " THEN WITHIN 3s MATCH (v) WHERE v.speed < 3 AS b"
    " RETURN t(b) - t(a) AS took, MIN(ttc(e, v)) OVER match AS ttc"
    " HAVING MAX(v.speed) OVER match < 4 AND took < 1",
)

MARGINS = """
CHECK apart: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) < 8 ROBUSTNESS;
CHECK faster: FORSOME (v:Vehicle) EVENTUALLY (v.speed > 8 AND prev(v.speed) <= 8) ROBUSTNESS;
CHECK met: FORALL (b:Bus|Truck) FORSOME (p:Person) EVENTUALLY dist(b, p) < 20 ROBUSTNESS;
CHECK turning: FORALL (v:Vehicle WHERE v.speed > 5)
  ALWAYS (delta(v.heading, 1s) < 20 OR run_length(v.speed < 3) < 2s) ROBUSTNESS;
CHECK lately: FORALL (v:Vehicle ABSENT AS TRUE) ALWAYS ONCE[0s, 5s] v.speed > 1 ROBUSTNESS;
CHECK stops: ALWAYS (ego.speed > 1 IMPLIES EVENTUALLY[0s, 3s] ego.speed < 1) AND ALWAYS ego.speed < 9
  ROBUSTNESS;
CHECK again: ALWAYS EVENTUALLY (ego.speed < 2 OR NOT (ego.speed > 1 UNTIL min_over(ego.speed, 1s) > 3))
  ROBUSTNESS;
CHECK near: FORALL (v:Vehicle) (EXISTS {(ego)-[:near]->(v)} AND v.speed < 5) SINCE[0s, 2s] v.speed > 9
  ROBUSTNESS;
"""

SEQUENCES = (
    "MATCH (e:Ego) WHERE e.speed < 1 THEN MATCH (e) WHERE e.speed > 5",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 12"
    " THEN WITHIN 2s MATCH (e), (v) WHERE dist(e, v) < 8 FOR >= 0.5s",
    "MATCH (v:Vehicle) WHERE v.speed > 5 THEN IMMEDIATELY MATCH (v) WHERE v.speed <= 5",
    "MATCH (v:Vehicle) WHERE v.speed > 3 UNTIL MATCH (v) WHERE v.speed <= 3 FOR < 3s",
    "MATCH (v:Vehicle) WHERE v.speed < 1 FOR >= 1s"
    " THEN NOT MATCH (v) WHERE v.speed > 4 THEN WITHIN 8s MATCH (v) WHERE v.speed > 2",
    "MATCH (v:Vehicle) WHERE v.speed > 5 THEN WITHIN 1s NOT MATCH (v) WHERE v.speed < 4",
    "MATCH (v:Vehicle) WHERE v.speed > 5 AND prev(v.speed) <= 5"
    " THEN AFTER 1s WITHIN 4s MATCH (v), (w:Vehicle) WHERE dist(v, w) < 8",
    "MATCH (v:Vehicle) WHERE v.speed > 2 AND EVENTUALLY[0s, 1s] v.speed < 1"
    " THEN WITHIN 2s MATCH (v) WHERE v.speed < 0.5",
    "USING MATCHES longest MATCH (v:Vehicle) WHERE v.speed > 5 THEN WITHIN 2s MATCH (v) WHERE v.speed < 5",
    "USING MATCHES first MATCH (v:Vehicle) WHERE v.speed < 1 THEN MATCH (v) WHERE v.speed > 4",
)


Watched = tuple[tuple["Verdict", ...], list["MonitorEvent"], Monitor]
"""Verdicts, what was told, and by whom."""


@dataclass
class Drive:
    """A recording: its store, its map, and its graphs, one frame after the other."""

    store: Store
    name: str
    road_map: RoadMap | None
    graphs: list[SceneGraph] = field(default_factory=list)
    stored: dict[int, str] = field(default_factory=dict)
    online: dict[int, str] = field(default_factory=dict)
    known: dict[tuple[str, bool], Watched] = field(default_factory=dict)
    """What was watched already."""

    @classmethod
    def of(cls, recording: Path, folder: Path, until: float | None = None) -> Drive:
        """Ingest a recording, or its first seconds, and make its graphs step by step."""
        path = folder / f"{recording.stem}.sgstore"
        if not path.exists():
            ingest(path, [recording], until=until)
        store = Store(path)
        ((name, count),) = store.sql("SELECT trace, count(*) FROM frames GROUP BY trace").values
        with opened(str(recording), Config()) as source:
            generator = SceneGraphGenerator(source.road_map, Config())
            graphs = [generator.step(frame) for frame in islice(source.frames, count)]
        stored = dict(store.sql("SELECT node_id, ident FROM entities").values)
        nodes = (node for graph in graphs for node in graph.known().nodes.items())
        online = {node: about["ident"] for node, about in nodes if "ident" in about}
        return cls(store, name, source.road_map, graphs, stored, online)

    def watched(self, text: str, *, sgsm_compat: bool = False) -> Watched:
        if (text, sgsm_compat) in self.known:
            return self.known[text, sgsm_compat]
        events: list[MonitorEvent] = []
        monitor = Monitor(
            text, self.road_map, trace=self.name, on_event=events.append, sgsm_compat=sgsm_compat
        )
        for graph in self.graphs:
            monitor.look([graph])
        return self.known.setdefault((text, sgsm_compat), (monitor.finish(), events, monitor))

    def compare_checks(self, text: str, *, sgsm_compat: bool = False) -> int:
        """Verdicts watched and stored; how many violations there are.

        A watched verdict of a check of driven lanes may be unknown instead of true: a lane was unsure.
        """
        verdicts, events, _ = self.watched(text, sgsm_compat=sgsm_compat)
        wanted = list(self.store.check(text, sgsm_compat=sgsm_compat))
        seen, stored = told(verdicts, self.online), told(wanted, self.stored)
        differ = [(a, b) for a, b in zip(seen, stored, strict=True) if a != b]
        later = [(name, "unknown", [], []) for name in checks_of_lanes(text)]
        differ = [(a, b) for a, b in differ if a not in later or b[1] == "false"]
        assert not differ, (self.name, differ)
        violated = Counter(event.name for event in events if event.kind == "violated")
        alone = {v.check: len(v.violations) for v in wanted if not v.witnesses and v.violated}
        assert {name: violated[name] for name in alone} == alone, (self.name, text)
        return sum(len(v.violations) for v in wanted)

    def compare_lanes(self, text: str) -> Counter[tuple[str, str]]:
        """Verdicts stored and watched; how many of each.

        Those of checks of driven lanes may be unknown while a lane is unsure.
        """
        maybe = checks_of_lanes(text)
        watched = {verdict.check: verdict for verdict in self.watched(text)[0]}
        found, opposite = Counter[tuple[str, str]](), list[tuple[str, str, str]]()
        for one in self.store.check(text):
            seen = watched[one.check]
            found[one.verdict, seen.verdict] += 1
            same = {one.verdict, "unknown"} if one.check in maybe else {one.verdict}
            opposite += [(one.check, one.verdict, seen.verdict)] * (seen.verdict not in same)
        assert not opposite, (self.name, opposite)
        return found

    def compare_margins(self, text: str) -> int:
        """By how much checks are met, watched and stored; how many numbers are finite."""
        verdicts, _, monitor = self.watched(text)
        stored = {verdict.check: verdict.robustness for verdict in self.store.check(text)}
        seen = {verdict.check: verdict.robustness for verdict in verdicts}
        assert seen.keys() == stored.keys()
        for check, one in seen.items():
            other = stored[check]
            assert (one is None) == (other is None), (self.name, check)
            if one is not None and other is not None:
                near = math.isclose(one.value, other.value, rel_tol=1e-9, abs_tol=1e-9)
                assert near, (self.name, check, one, other)
                assert monitor.robustness[check] == one
                assert bool(one.condition) == bool(other.condition), (self.name, check, one, other)
        return sum(one is not None and math.isfinite(one.value) for one in seen.values())

    def compare_matches(self, texts: Sequence[str]) -> list[int]:
        """What is found, by the frame it begins in and who it is; how often, of each."""
        _, events, monitor = self.watched(";\n".join(texts))
        often: list[int] = []
        for number, text in enumerate(texts, start=1):
            name = "pattern" if len(texts) == 1 else f"pattern {number}"
            found = self.store.find(text)
            own = [event for event in events if event.name == name]
            if found.left_out:  # that something is never known is not known before the end
                assert own == [], (self.name, text)
                often.append(0)
                continue
            assert name in monitor.names, (self.name, text)
            intervals = list(found.intervals())
            whole = {n for one in intervals for n, v in one.values.items() if isinstance(v, int)}
            wanted = Counter((i.start_seq, _who(i.values, whole, self.stored)) for i in intervals)
            seen = Counter((e.start.seq, _who(e.nodes, whole, self.online)) for e in own)
            assert wanted == seen, (self.name, text)
            assert all(e.start.seq <= e.end.seq <= e.told.seq for e in own), (self.name, text)
            often.append(len(intervals))
        return often

    def compare_values(self, texts: Sequence[str]) -> int:
        """Values over matches, watched and stored; how many matches there are."""
        _, events, _ = self.watched(";\n".join(texts))
        many = 0
        for number, text in enumerate(texts, start=1):
            name = "pattern" if len(texts) == 1 else f"pattern {number}"
            told = (event.values for event in events if event.name == name)
            seen = Counter(_rounded(one.values()) for one in told)
            found = self.store.find(text)
            if " AS a" in text:
                stored = Counter(map(_rounded, found))
                assert seen == stored, (self.name, text, seen - stored, stored - seen)
            else:
                runs = {_rounded(one.values.values()) for one in found.intervals()}
                assert set(seen) == runs, (self.name, text, set(seen) ^ runs)
            many += sum(seen.values())
        return many

    def compare_edges(self, questions: Sequence[tuple[str, list[str]]]) -> int:
        """Patterns with conditions on an edge variable, told where a store has them true; how many runs.

        Each question is a pattern, whose edge variable is the only other name than e and v, and conditions.
        A leader is missing while that of its follower is unsure.
        """
        texts = [f"MATCH {pattern} WHERE {one}" for pattern, made in questions for one in made]
        _, events, _ = self.watched(";\n".join(texts))
        number, runs = 0, 0
        unsure = {(g.seq, self.online[node]) for g in self.graphs for node in g.unsure_lead}
        for pattern, made in questions:
            told = ", ".join(
                f"ONCE[0frames, 0frames] ({one}) AS y{n}" for n, one in enumerate(made)
            )
            edge = "d" if "[d:" in pattern else "r"
            asked = f"MATCH {pattern} RETURN frame.seq, e, v, type({edge}) AS w, {told}"
            rows = list(self.store.find(asked))
            for place, one in enumerate(made, start=4):
                number += 1
                true = {(seq, e, v, w) for seq, e, v, w, *y in rows if y[place - 4]}
                begun = [row for row in true if (row[0] - 1, *row[1:]) not in true]
                wanted = Counter(
                    (seq, self.stored.get(e, e), self.stored.get(v, v)) for seq, e, v, _ in begun
                )
                seen = Counter(
                    (
                        event.start.seq,
                        *(self.online.get(event.nodes[n], event.nodes[n]) for n in "ev"),
                    )
                    for event in events
                    if event.name == f"pattern {number}"
                )
                missed = wanted - seen
                if "leads" in pattern or "follows" in pattern:  # v is the follower.
                    missed = Counter(row for row in missed if (row[0], row[2]) not in unsure)
                wrong = (seen - wanted) + missed
                assert not wrong, (self.name, pattern, one, wrong)
                runs += len(begun)
        return runs


def _rounded(values: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(round(v, 5) + 0.0 if isinstance(v, int | float) else v for v in values)


def _who(values: Any, names: set[str], idents: dict[int, str]) -> tuple[tuple[str, Any], ...]:
    """Who is bound to some names, by their own ids: those of nodes are given in another order online."""
    return tuple(sorted((n, idents.get(v, v)) for n, v in values.items() if n in names))


def told(verdicts: Sequence[Verdict], idents: dict[int, str]) -> list[tuple[Any, ...]]:
    found: list[tuple[Any, ...]] = []
    for verdict in sorted(verdicts, key=_name):
        who = [
            (_who(w.nodes, set(w.nodes), idents), w.holds, [_span(one) for one in w.violations])
            for w in verdict.witnesses
        ]
        spans = [_span(one) for one in verdict.violations]
        found.append((verdict.check, verdict.verdict, spans, sorted(who)))
    return found


def _span(one: Interval) -> tuple[int, int, int, int, int]:
    return one.start_seq, one.end_seq, one.start_ns, one.end_ns, one.frames


def _name(verdict: Verdict) -> str:
    return verdict.check


def library_checks(one_in: int = 1) -> str:
    """One of so many of the rules of the library, all of them in a long run."""
    found = some([p.text for p in patterns().values() if p.is_check], one_in)
    return ";\n".join(text.strip().rstrip(";") for text in found)


OF_LANES = WAYS | {"ttc_lane", "leads", "follows", "primary", "is_primary", "is_own", "role"}
"""Words of a query that depend on the lanes that vehicles drive."""


def of_lanes(text: str) -> bool:
    """True if a text depends on driven lanes, also through predicates of the library."""
    words, more = set[str](), {text}
    while more:
        more = {word for one in more for word in re.findall(r"\w+", one)} - words
        words |= more
        more = {one.text for name, one in patterns().items() if name in more}
    return bool(words & OF_LANES)


def checks_of_lanes(text: str) -> set[str]:
    """Names of the checks in a text that depend on driven lanes."""
    parts = re.split(r"\bCHECK (\w+):", text)
    named = zip(parts[1::2], parts[2::2], strict=True)
    return {name for name, one in named if of_lanes(one)}


def worldwide(text: str) -> str:
    """The checks with all known data."""
    return ";".join(f"USING SCOPE world {one}" for one in text.split(";"))


def library_matches() -> list[str]:
    """All but those that ask who is parked, which is known only when the trace has ended."""
    found = [p for p in patterns().values() if p.kind != "predicate" and not p.is_check]
    found = [pattern for pattern in found if "parked" not in pattern.text]
    return [pattern.text.strip().rstrip(";") for pattern in found]


def compare(recording: Path, folder: Path) -> tuple[int, int, int]:
    """Frames, violations and matches of a recording, if nothing differs."""
    drive = Drive.of(recording, folder)
    violations = sum(drive.compare_checks(CHECKS, sgsm_compat=one) for one in (False, True))
    for text in (library_checks(), LANE_RULES, worldwide(LANE_RULES)):
        drive.compare_lanes(text)
    drive.compare_margins(MARGINS)
    matches = sum(drive.compare_matches([*SEQUENCES, *library_matches()]))
    matches += drive.compare_values(VALUES)
    return len(drive.graphs), violations, matches


def recordings(folders: Iterable[str]) -> Iterator[Path]:
    """Those that are whole."""
    yield RECORDING
    for folder in map(Path, folders):
        for path in sorted([*folder.rglob("*.mcap"), *folder.rglob("*.osi")]):
            if "damaged" not in path.parts:
                yield path


if __name__ == "__main__":
    differs = 0
    for one in recordings(sys.argv[1:]):
        with tempfile.TemporaryDirectory() as made:
            try:
                print(one.name, *compare(one, Path(made)), flush=True)
            except SgstoreError as error:
                print(one.name, "is not read:", error, flush=True)
            except AssertionError as error:
                print(one.name, "differs:", error, flush=True)
                differs += 1
    sys.exit(f"{differs} recordings differ" if differs else None)
