"""Reports: a page that holds what a query found, and needs nothing else."""

from __future__ import annotations

import base64
import gzip
import hashlib
import itertools
import json
import re
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from sgstore.apps.cli import run
from sgstore.apps.report import chosen_spread, report
from sgstore.errors import QueryError
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(6)

NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > $least"


def kept_in(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="kept">(.*?)</script>', page.read_text())
    assert found
    return json.loads(found[1])


def columns_of(told: str) -> tuple[dict[str, Any], dict[str, Any]]:
    data = gzip.decompress(base64.b64decode(told))
    (length,) = struct.unpack_from("<I", data)
    header, place = json.loads(data[8 : 8 + length]), (8 + length + 7) // 8 * 8
    columns = {}
    for name, kind, many in header["columns"]:
        columns[name] = np.frombuffer(data, f"<{kind}", many, place)
        place = (place + columns[name].nbytes + 7) // 8 * 8
    return header, columns


@pytest.fixture(scope="module")
def store(town_store: Path) -> Store:
    return Store(town_store)


@pytest.fixture(scope="module")
def page(store: Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = tmp_path_factory.mktemp("report") / "near.html"
    spans = list(store.find(NEAR, least=1).intervals())
    told = report(store, NEAR, page, parameters={"least": 1}, around_s=1.5)
    assert told == (len(spans), False)
    return page


def test_it_holds_the_matches_and_their_lanes(page: Path, store: Store) -> None:
    kept = kept_in(page)
    spans = list(store.find(NEAR, least=1).intervals())
    rows = [row for reply in kept["find"] for row in reply.get("matches", ())]
    assert [(r[0], r[1], r[2]) for r in rows] == [(s.trace, s.start_seq, s.end_seq) for s in spans]

    for span in spans:
        binding = {"e": span.values["e"], "v": span.values["v"]}
        key = json.dumps([span.trace, binding], separators=(",", ":"))
        lanes = store.parts(NEAR, f"{span.trace}#{span.start_seq}", binding, least=1)
        told = kept["parts"][key]["lanes"]
        assert [one["spans"] for one in told] == [
            [list(s) for s in one.spans] for one in lanes.lanes
        ]


def test_states_are_those_of_the_frames_around_the_matches(page: Path, store: Store) -> None:
    kept = kept_in(page)
    (trace,) = kept["about"]["traces"]
    around = int(1.5 / trace["period"])
    wanted = {
        seq
        for span in store.find(NEAR, least=1).intervals()
        for seq in range(max(span.start_seq - around, 0), min(span.end_seq + around, 749) + 1)
    }
    sql = """SELECT f.seq, count(*), sum(n.x) FROM nodes n JOIN frames f USING (frame_id)
        WHERE NOT n.is_static GROUP BY f.seq"""
    known = {seq: (many, x) for seq, many, x in store.sql(sql).values}
    seen = set[int]()
    for key, told in kept["columns"].items():
        if not key.startswith('["api/states"'):
            continue
        header, columns = columns_of(told)
        for row, seq in enumerate(columns["frame.seq"].tolist()):
            first, last = columns["frame.start"][row : row + 2]
            if first < last:
                seen.add(seq)
                many, x = known[seq]
                assert last - first == many
                found = columns["x"][first:last].astype(float) + trace["origin"][0]
                assert found.sum() == pytest.approx(x, abs=0.005 * many)
        assert header["last"] - header["first"] + 1 == len(columns["frame.seq"])

    assert seen == wanted & known.keys()


def test_its_policy_allows_its_script_and_nothing_else(page: Path) -> None:
    text = page.read_text()
    policy = re.search(r'http-equiv="content-security-policy" content="([^"]*)"', text)
    script = re.search(r'<script type="module">(.*?)</script>', text, re.DOTALL)
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
    assert policy
    assert script
    assert style
    for code in (script[1], style[1]):
        digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy[1]
    assert policy[1].startswith("default-src 'none'; ")
    assert "unsafe" not in policy[1]
    assert "http" not in re.sub(
        r"http-equiv|http://www\.w3\.org/[\w/]*", "", text.replace(script[1], "")
    )
    assert re.findall(r"""(?:src|href)=["']""", text.replace(script[1], "")) == []


def test_hostile_names_stay_text(store: Store, tmp_path: Path) -> None:
    page = tmp_path / "<b>&.html"
    query = "MATCH (e:Ego) WHERE e.speed > 1 AND trace.name <> '</script><script>alert(1)</script>'"
    report(store, query, page)

    assert page.read_text().count("</script>") == 2
    assert "<title>&lt;b&gt;&amp;</title>" in page.read_text()
    assert kept_in(page)["query"] == query


def test_no_more_matches_than_wanted(store: Store, tmp_path: Path) -> None:
    assert report(store, NEAR, tmp_path / "r.html", parameters={"least": 1}, most=2) == (2, True)
    told = kept_in(tmp_path / "r.html")["find"]
    rows = [row for reply in told for row in reply.get("matches", ())]
    whole = list(store.find(NEAR, least=1).intervals())
    assert [row[1] for row in rows] == [whole[0].start_seq, whole[-1].start_seq]  # spread in time
    check = "CHECK far: FORALL (v:Vehicle) ALWAYS dist(ego, v) > 4"
    report(store, check, tmp_path / "c.html", most=2)
    (verdict,) = kept_in(tmp_path / "c.html")["check"]["verdicts"]
    (found,) = store.check(check)
    spans = found.violations
    assert [span[0] for span in verdict["spans"]] == [spans[0].start_seq, spans[-1].start_seq]
    assert verdict["violations"] == len(spans) > 2


def test_matches_of_a_report_keep_the_order_of_the_query(store: Store, tmp_path: Path) -> None:
    text = f"{NEAR} ORDER BY gap(e, v)"
    report(store, text, tmp_path / "r.html", parameters={"least": 1}, most=3)
    told = kept_in(tmp_path / "r.html")["find"]
    rows = [row for reply in told for row in reply.get("matches", ())]

    assert [row[1] for row in rows] == [one.seq for one in store.find(text, least=1).head(3)]
    least = f"{NEAR} RETURN MIN(gap(e, v)) AS least"
    assert report(store, least, tmp_path / "l.html", parameters={"least": 1}) == (0, False)
    (told,) = kept_in(tmp_path / "l.html")["find"]
    assert told["rows"] == [list(row) for row in store.find(least, least=1)]


@pytest.mark.parametrize("most", [1, 4, 7, 9, 30])
def test_matches_of_a_report_are_spread_over_traces(most: int) -> None:
    """As many as wanted; no trace has more than one above another that has more to give."""
    traces = [*"aaaaaaaaaaaa", *"b", *"ccccc", *"aa", *"dd"]
    kept = chosen_spread(traces, most)
    share = {trace: sum(traces[at] == trace for at in kept) for trace in "abcd"}

    assert len(kept) == min(most, len(traces))
    for one, other in itertools.permutations("abcd", 2):
        assert share[one] <= share[other] + 1 or share[other] == traces.count(other)
    if share["a"] > 1:
        assert {0, 19} <= kept  # the first and the last


def test_a_hundred_matches_are_small(store: Store, tmp_path: Path) -> None:
    page = tmp_path / "many.html"
    many, _ = report(store, "MATCH (v:Vehicle)-[:near]->(w:Vehicle)", page)

    assert many == 100
    assert page.stat().st_size < 2.5e6


def test_violations_of_checks_with_pictures(store: Store, tmp_path: Path) -> None:
    page = tmp_path / "slow.html"
    told = report(store, "CHECK slow: FORALL (v:Vehicle) v.speed < 5", page, pictures=True)
    kept = kept_in(page)
    (verdict,) = store.check("CHECK slow: FORALL (v:Vehicle) v.speed < 5")

    assert told == (len(verdict.violations), False)
    assert [one["verdict"] for one in kept["check"]["verdicts"]] == [verdict.verdict]
    ((key, pictures),) = kept["pictures"].items()
    trace, topic = json.loads(key)
    first = min(map(int, pictures))
    assert base64.b64decode(pictures[str(first)]) in store.payload(f"{trace}#{first}", topic)


def test_the_verb_writes_it(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = tmp_path / "r.html"
    with pytest.raises(QueryError):
        report(Store(town_store), "MATCH (", to)
    assert not to.exists()
    assert (
        run(["report", str(town_store), NEAR, "--param", "least=1", "--limit", "3", "-o", str(to)])
        == 0
    )
    told = capsys.readouterr()
    assert told.out.strip() == str(to)
    assert "the page has only the first 3 matches" in told.err
    assert kept_in(to)["parameters"] == {"least": 1}
    assert run(["report", str(town_store), "-o", str(to)]) == 2
