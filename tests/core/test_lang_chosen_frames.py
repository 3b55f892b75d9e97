"""A limit or ``HAVING`` chooses the same frames in each form of a result."""

from __future__ import annotations

import shutil
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from sgstore.collection import Collection, pack
from sgstore.errors import QueryError

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.matches import FrameRef, Matches
    from sgstore.query import Store

pytestmark = [pytest.mark.seconds(20), pytest.mark.usefixtures("own_cache")]

NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
VERY = "MATCH (e:Ego)-[:near]->(v:Vehicle) WHERE e.speed < 1"
LEADS = "MATCH (e:Ego)-[:near]->(v:Vehicle) THEN WITHIN 2s MATCH (e)-[:near_coll]->(v)"
SECOND = 10**9
FORMS = [
    "LIMIT 3",
    "RETURN *, frame.seq AS n ORDER BY n DESC LIMIT 3",
    "RETURN FRAMES LIMIT 60",
    "RETURN FRAMES SKIP 30",
    "RETURN INTERVALS LIMIT 2",
    "RETURN v.name, INTERVALS ORDER BY frames DESC LIMIT 2",
    "RETURN INTERVALS SKIP 1",
    "RETURN v.name, INTERVALS HAVING frames > 9",
    "RETURN CLIPS(-1s, 1s) LIMIT 2",
    "RETURN CLIPS(-1s, 1s) ORDER BY start_ns DESC LIMIT 1",
    "RETURN v.name, CLIPS(-1s, 1s) LIMIT 1 PER trace.name",
    "RETURN v.name, MIN(gap(e, v)) OVER match AS least, CLIPS(-1s, 1s) HAVING least < 1",
    "RETURN SUBGRAPHS LIMIT 4",
]
BOTH = [f"{NEAR} {form} UNION {VERY} {form}" for form in FORMS]
SEQUENCES = [f"{LEADS} {form}" for form in FORMS if "OVER" not in form and "FRAMES" not in form]


@pytest.fixture(scope="module")
def fleet(town_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Collection:
    folder = tmp_path_factory.mktemp("fleet")
    pack(
        shutil.copy(town_store, folder / "town.sgstore"), folder / "fleet"
    )  # the other one is open
    return Collection(folder / "fleet")


def listed(matches: Matches, every: list[FrameRef]) -> list[FrameRef]:
    """Return the frames of a pattern, reduced to those of the listed rows."""
    rows = matches.rows()
    if matches.columns[0] == "frame_id":
        return [one for one in every if any(one.frame_id == row[0] for row in rows)]
    if matches.columns[1] == "start_seq":
        return [one for one in every if any(row[1] <= one.seq <= row[2] for row in rows)]
    return [
        one
        for one in every
        if any(row[1] + SECOND <= one.log_time_ns <= row[2] - SECOND for row in rows)
    ]


def runs(frames: list[FrameRef]) -> list[tuple[int, int]]:
    """Return first and last log time of the runs of frames with consecutive numbers."""
    cuts = [n for n, (a, b) in enumerate(pairwise(frames), 1) if b.seq != a.seq + 1]
    ends = zip([0, *cuts], [*cuts, len(frames)], strict=True)
    return [(frames[a].log_time_ns, frames[b - 1].log_time_ns) for a, b in ends if b > a]


def joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    for start, end in sorted(spans):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((start, end))
    return found


def law(matches: Any, every: Any, wanted: list[FrameRef]) -> None:
    """Compare frames, count, clips and intervals of chosen matches with those of all matches."""
    rows = matches.rows()
    clips = [(one.start_ns, one.end_ns) for one in matches.clips()]
    spans = [(one.start_seq, one.end_seq) for one in matches.intervals()]

    assert 0 < len(wanted) < every.count()
    assert sorted(one.seq for one in matches.frames()) == [one.seq for one in wanted]
    assert matches.count() == len(wanted)
    if matches.columns[1] == "start_ns":
        assert clips == joined([(row[1], row[2]) for row in rows])
    else:
        assert clips == runs(wanted)
    if matches.columns[1] == "start_seq":
        assert sorted(spans) == sorted((row[1], row[2]) for row in rows)
    else:
        assert spans
        assert all(any(a <= one.seq <= b for one in wanted) for a, b in spans)
        assert all(any(a <= one.seq <= b for a, b in spans) for one in wanted)


def frames_of(pattern: str, store: Any) -> list[FrameRef]:
    return [*store.find(pattern).frames()]


@pytest.mark.parametrize("query", [*(f"{NEAR} {form}" for form in FORMS), *SEQUENCES])
def test_each_form_has_the_frames_of_the_listed_rows(query: str, open_town: Store) -> None:
    pattern = LEADS if query.startswith(LEADS) else NEAR
    matches, every = open_town.find(query), open_town.find(pattern)

    law(matches, every, sorted(listed(matches, [*every.frames()]), key=lambda one: one.seq))


@pytest.mark.parametrize("query", BOTH)
def test_each_form_of_a_union_has_the_frames_of_its_parts(query: str, open_town: Store) -> None:
    parts = query.split(" UNION ")
    each = zip(map(open_town.find, parts), (NEAR, VERY), strict=True)
    wanted = [one for part, pattern in each for one in listed(part, frames_of(pattern, open_town))]
    unique = {one.seq: one for one in wanted}

    law(
        open_town.find(query),
        open_town.find(f"{NEAR} UNION {VERY}"),
        [unique[seq] for seq in sorted(unique)],
    )


@pytest.mark.parametrize("form", ["", "RETURN FRAMES", "RETURN INTERVALS", "RETURN CLIPS(-1s, 1s)"])
def test_a_limited_union_has_the_frames_of_its_rows(form: str, open_town: Store) -> None:
    whole = open_town.find(f"{NEAR} {form} UNION {VERY} {form}")
    matches = whole.limit(2)

    law(matches, whole, listed(matches, [*whole.frames()]))


def test_limited_values_of_a_union_have_no_frames(open_town: Store) -> None:
    matches = open_town.find(f"{NEAR} RETURN v.name AS n UNION {VERY} RETURN v.name AS n").limit(1)

    with pytest.raises(QueryError, match="limited rows of a UNION have no frames"):
        matches.count()


@pytest.mark.parametrize("form", FORMS[:9])
def test_a_collection_has_the_same_frames(form: str, fleet: Collection, open_town: Store) -> None:
    for query in (f"{NEAR} {form}", f"{NEAR} {form} UNION {VERY} {form}"):
        one, other = fleet.find(query), open_town.find(query)

        assert [found.seq for found in one.frames()] == [found.seq for found in other.frames()]
        assert one.count() == other.count()
        assert [*one.clips()] == [*other.clips()]
        assert [*one.intervals()] == [*other.intervals()]


@pytest.mark.parametrize("form", ["RETURN FRAMES LIMIT 3", "RETURN v, CLIPS(-1s, 1s) LIMIT 1"])
def test_an_export_has_the_clips_of_the_chosen_frames(
    form: str, open_town: Store, tmp_path: Path
) -> None:
    matches = open_town.find(f"{NEAR} {form}")
    written = open_town.export(f"{NEAR} {form}", to=tmp_path / "clips", before=0, after=0)

    spans = [(one.start_ns, one.end_ns) for one in written]
    assert spans == [(one.start_ns, one.end_ns) for one in matches.clips()]
