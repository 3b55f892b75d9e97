"""Tables of users' own, joined to frames in SQL and in patterns; and results as tables of others."""

from __future__ import annotations

import csv
import json
import sys
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from typer.testing import CliRunner

import sgstore
from sgstore.apps.cli import app
from sgstore.apps.sandbox import Sandbox
from sgstore.base.temporary_folders import temporary_folder
from sgstore.errors import MissingExtraError, QueryError, StoreError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(8)

FRAMES = "MATCH (e:Ego) RETURN FRAMES"


@pytest.fixture(scope="module")
def path(town_store: Path, kept_open: Callable[[Path], None]) -> Path:
    kept_open(town_store)
    return town_store


@pytest.fixture(scope="module")
def frames(path: Path) -> list[tuple[Any, ...]]:
    return list(sgstore.open(path).find(FRAMES))


@pytest.fixture
def table(tmp_path: Path):
    def write(name: str, columns: list[str], rows: list[tuple[Any, ...]]) -> Path:
        file = tmp_path / name
        if file.suffix == ".json":
            file.write_text(json.dumps([dict(zip(columns, row, strict=True)) for row in rows]))
        elif file.suffix == ".ndjson":
            lines = (json.dumps(dict(zip(columns, row, strict=True))) for row in rows)
            file.write_text("\n".join(lines))
        else:
            with file.open("w", newline="") as stream:
                writer = csv.writer(stream, delimiter="\t" if file.suffix == ".tsv" else ",")
                writer.writerows([columns, *rows])
        return file

    return write


def scores(frames: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    return [(row[0], row[2] % 7 / 2) for row in frames]


@pytest.mark.parametrize("ending", ["csv", "tsv", "json", "ndjson", "parquet"])
def test_a_file_of_any_form_is_joined_by_frame_id(ending, path, frames, table) -> None:
    file = table(
        f"labels.{'csv' if ending == 'parquet' else ending}", ["frame_id", "score"], scores(frames)
    )
    if ending == "parquet":
        parquet = file.with_suffix(".parquet")
        duckdb.sql(f"COPY (FROM read_csv('{file}')) TO '{parquet}'")
        file = parquet
    store = sgstore.open(path, tables={"labels": file})

    rows = store.sql("SELECT seq, score FROM frames JOIN labels USING (frame_id) ORDER BY seq")
    found = store.find("MATCH (e:Ego) WHERE labels.score > 2.5 RETURN frame.seq, labels.score")

    assert rows.values == [(row[2], row[2] % 7 / 2) for row in frames]
    assert list(found) == [(row[2], 3.0) for row in frames if row[2] % 7 == 6]
    assert found.count() == len(list(found))


@pytest.mark.parametrize("key", ["seq", "time_ns", "t"])
def test_rows_belong_to_frames_by_trace_and_number_or_time(key, path, frames, table) -> None:
    at = {"seq": 2, "time_ns": 3, "t": 4}[key]
    rows = [("town", row[at], row[2]) for row in frames if row[2] % 3 == 0]
    file = table("labels.csv", ["trace", key, "number"], [*rows, ("other", rows[0][1], -1)])
    store = sgstore.open(path, tables={"labels": file})

    found = store.sql("SELECT f.seq, l.number FROM labels l LEFT JOIN frames f USING (frame_id)")

    assert sorted(found.values, key=str) == sorted(
        [(row[2], row[2]) for row in frames if row[2] % 3 == 0] + [(None, -1)], key=str
    )
    joined = store.file.joined()["labels"]
    assert (joined.rows, joined.matched, joined.frames) == (len(rows) + 1, len(rows), len(rows))


def test_a_time_means_the_frame_that_is_nearest_within_half_a_period(path, frames, table) -> None:
    times = [row[4] for row in frames]
    asked = [times[5] + 0.04, times[5] - 0.04, times[0] - 0.04, times[0] - 0.06, times[-1] + 0.06]
    asked += [(times[i] * 3 + times[i + 1]) / 4 for i in range(0, 600, 7)]
    file = table("labels.csv", ["trace", "t"], [("town", t) for t in asked])
    store = sgstore.open(path, tables={"labels": file})

    found = dict(
        store.sql("SELECT l.t, f.t FROM labels l LEFT JOIN frames f USING (frame_id)").values
    )

    for t in asked:
        nearest = min(times, key=lambda one: abs(one - t))
        near = abs(nearest - t) <= 0.05  # frames are 0.1 s apart
        assert found[t] == (pytest.approx(nearest) if near else None)


def test_a_table_without_frames_is_joined_by_whatever_it_has(path, table) -> None:
    file = table("limits.csv", ["kind", "limit_ms"], [("car", 9.0), ("person", 3.0)])
    store = sgstore.open(path, tables={"limits": file})

    rows = store.sql(
        "SELECT n.kind, count(*) FROM nodes n JOIN limits l ON l.kind = n.kind::VARCHAR"
        " WHERE n.speed > l.limit_ms GROUP BY ALL"
    )

    assert len(rows) > 0
    with pytest.raises(QueryError, match="no rows that belong to frames"):
        store.find("MATCH (e:Ego) WHERE limits.limit_ms > 3")


def test_what_the_table_lacks_is_unknown(path, frames, table) -> None:
    file = table("labels.csv", ["frame_id", "bad"], [(frames[3][0], "true"), (frames[4][0], "")])
    store = sgstore.open(path, tables={"labels": file})

    assert store.find("MATCH (e:Ego) WHERE labels.bad").count() == 1
    assert store.find("MATCH (e:Ego) WHERE NOT labels.bad").count() == 0
    assert store.find("MATCH (e:Ego) WHERE labels.bad IS NULL").count() == len(frames) - 1


def test_a_pattern_with_labels_can_be_explained(path, frames, table) -> None:
    file = table("labels.csv", ["frame_id", "score"], scores(frames))
    store = sgstore.open(path, tables={"labels": file})

    answer = store.why_not(frames[2][0], "MATCH (e:Ego) WHERE labels.score > 2")

    assert (answer.failed, answer.found) == ("labels.score > 2", "labels.score = 1")


def test_several_rows_for_a_frame_are_no_attribute_of_it(path, frames, table) -> None:
    file = table("seen.csv", ["frame_id", "what"], [(frames[0][0], "a"), (frames[0][0], "b")])
    store = sgstore.open(path, tables={"seen": file})

    assert len(store.sql("SELECT * FROM seen JOIN frames USING (frame_id)")) == 2
    with pytest.raises(QueryError, match="it has 2 rows for 1 frame"):
        store.find("MATCH (e:Ego) WHERE seen.what = 'a'")


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("labels.csv", None, "file not found"),
        ("labels.xlsx", "x", "cannot be read; expected a file that ends in .parquet"),
        (
            "labels.parquet",
            "nonsense",
            "table labels: .*labels.parquet: .*No magic bytes|too small",
        ),
        ("labels.json", '[{"a": 1}, {"a"', "table labels: .*labels.json: "),
        ("labels.csv", "", "an empty file"),
    ],
)
def test_what_is_no_table_is_refused_with_its_name(name, text, reason, path, tmp_path) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)

    with pytest.raises(StoreError, match=reason):
        sgstore.open(path, tables={"labels": tmp_path / name})


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("frames", "the store has a table or view 'frames' of its own"),
        ("STATE", "the store has a table or view 'STATE' of its own"),
        ("ego", "not a name for a table"),
        ("a b", "not a name for a table"),
        ('x"; DROP', "not a name for a table"),
    ],
)
def test_names_that_are_taken_are_refused(name, reason, path, table) -> None:
    file = table("labels.csv", ["a"], [(1,)])

    with pytest.raises(StoreError, match=reason):
        sgstore.open(path, tables={name: file}).sql("SELECT 1")


def test_odd_names_of_files_and_columns_are_just_names(path, frames, tmp_path) -> None:
    file = tmp_path / "it's [1]*.csv"
    file.write_text(f'frame_id,"the ""score"""\n{frames[0][0]},5\n')
    (tmp_path / "it's 1x.csv").write_text("frame_id\n1\n")
    store = sgstore.open(path, tables={"labels": file})

    assert store.sql("SELECT * FROM labels").dicts() == [
        {"frame_id": frames[0][0], 'the "score"': 5}
    ]


def test_readers_see_the_tables_and_no_other_file(path, table) -> None:
    file = table("labels.csv", ["a"], [(1,)])
    store = sgstore.open(path, tables={"labels": file})

    assert len(store.sql("SELECT * FROM labels")) == 1
    with pytest.raises(StoreError, match="disabled by configuration"):
        store.sql(f"SELECT * FROM read_csv('{file}')")
    with pytest.raises(StoreError, match="disabled by configuration"):
        store.sql(f"SELECT * FROM glob('{temporary_folder() / 'tables'}/../*')")
    with pytest.raises(StoreError, match="labels"):
        sgstore.open(path).sql("SELECT * FROM labels")


def test_a_label_that_is_misspelt_is_told(path, frames, table) -> None:
    file = table("labels.csv", ["frame_id", "score"], scores(frames))
    store = sgstore.open(path, tables={"labels": file})

    with pytest.raises(
        QueryError, match=r"unknown column of labels 'scroe'\n.*\n.*\ndid you mean 'score'"
    ):
        store.find("MATCH (e:Ego) WHERE labels.scroe > 1")
    with pytest.raises(QueryError, match="did you mean 'labels'"):
        store.find("MATCH (e:Ego) WHERE lables.score > 1")


# The command line


def run(*arguments: Any) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize("safe", [[], ["--safe", "--timeout", "20s"]])
def test_tables_are_joined_on_the_command_line(safe, path, frames, table) -> None:
    file = table("my labels.csv", ["frame_id", "score"], scores(frames))

    by_pattern = run(
        "find", path, "MATCH (e:Ego) WHERE my_labels.score = 3 RETURN frame.seq", "--with", file, "--json",
        *safe,
    )  # fmt: skip
    sql = 'SELECT seq AS "frame.seq" FROM frames JOIN s USING (frame_id) WHERE score = 3 ORDER BY 1'
    by_sql = run("sql", path, sql, "--with", f"s={file}", "--json", *safe)

    assert json.loads(by_pattern.stdout) == json.loads(by_sql.stdout)
    assert len(json.loads(by_sql.stdout)) == sum(row[2] % 7 == 6 for row in frames)


def test_rows_that_belong_to_no_frame_are_told(path, frames, table) -> None:
    file = table("labels.csv", ["frame_id", "a"], [(frames[0][0], 1), (17, 2), ("x", 3)])

    result = run("sql", path, "SELECT count(*) FROM labels", "--with", file)

    assert "labels: 2 of 3 rows without a frame of the store" in result.stderr


@pytest.mark.parametrize("ending", ["csv", "json", "ndjson", "parquet", "arrow"])
def test_the_name_of_a_file_says_its_form(ending, path, frames, tmp_path) -> None:
    file = tmp_path / f"rows.{ending}"

    assert run("sql", path, "SELECT frame_id, t FROM frames", "-o", file).exit_code == 0
    again = tmp_path / "again.arrow"
    if ending == "arrow":
        arrow = pytest.importorskip("pyarrow")
        table = arrow.ipc.open_file(str(file)).read_all()
        assert table.column("frame_id").to_pylist() == [row[0] for row in frames]
        assert str(table.schema.field("t").type) == "double"
    else:
        read = sgstore.open(path, tables={"again": file}).sql(
            "SELECT frame_id FROM again ORDER BY 1"
        )
        assert [row[0] for row in read] == [row[0] for row in frames]
    assert not again.exists()


# Results as tables of others


def test_results_are_tables_of_arrow_and_polars_with_the_types_of_the_store(path, frames) -> None:
    store = sgstore.open(path)
    pytest.importorskip("pyarrow")
    polars = pytest.importorskip("polars")
    rows = store.sql("SELECT frame_id, t, trace, NULL::DOUBLE AS nothing, true AS yes FROM frames")
    found = store.find(
        "MATCH (e:Ego) RETURN frame.id AS frame_id, e.speed AS speed, e.kind AS kind"
    )

    assert [str(field.type) for field in rows.arrow().schema] == [
        "int64", "double", "string", "double", "bool",
    ]  # fmt: skip
    assert store.sql("SELECT frame_id FROM frames WHERE false").arrow().schema.names == ["frame_id"]
    frame = found.polars()
    assert frame.columns == ["frame_id", "speed", "kind"]
    assert frame.schema["speed"] == polars.Float64
    assert frame["frame_id"].to_list() == [row[0] for row in frames]
    assert found.arrow().column("frame_id").to_pylist() == frame["frame_id"].to_list()
    assert rows.polars()["yes"].all()


def test_data_frames_of_others_are_tables(path, frames) -> None:
    polars = pytest.importorskip("polars")
    labels = polars.DataFrame(
        {"frame_id": [r[0] for r in frames], "odd": [r[2] % 2 == 1 for r in frames]}
    )
    store: Store = sgstore.open(path, tables={"labels": labels, "arrow": labels.to_arrow()})

    assert store.find("MATCH (e:Ego) WHERE labels.odd").count() == len(frames) // 2
    assert store.find("MATCH (e:Ego) WHERE arrow.odd").count() == len(frames) // 2


def test_results_go_to_files_from_python(path, frames, tmp_path) -> None:
    store = sgstore.open(path)
    found = store.find("MATCH (e:Ego)-[:near]->(v:Vehicle)")

    assert (
        found.parquet(tmp_path / "a.parquet") == found.csv(tmp_path / "a.csv") == len(list(found))
    )
    assert store.sql("SELECT * FROM frames").csv(tmp_path / "f.csv") == len(frames)
    assert store.sql("SELECT * FROM frames").parquet(tmp_path / "f.parquet") == len(frames)
    both = sgstore.open(path, tables={"a": tmp_path / "a.parquet", "b": tmp_path / "a.csv"})
    assert both.sql("SELECT count(*) FROM a JOIN b USING (frame_id, e, v)").values == [
        (len(list(found)),)
    ]


@pytest.mark.parametrize(
    ("package", "method"), [("pandas", "df"), ("polars", "polars"), ("pyarrow", "arrow")]
)
def test_a_package_that_is_missing_is_named(package, method, path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    rows = sgstore.open(path).sql("SELECT 1 AS a")

    with pytest.raises(MissingExtraError, match=r"pip install 'sgstore\["):
        getattr(rows, method)()


# Strangers


def test_a_table_is_read_in_the_process_of_the_sandbox(path, frames, table) -> None:
    file = table("labels.csv", ["frame_id", "score"], scores(frames))

    with Sandbox(path, timeout_s=600, tables={"labels": file}) as box:
        count = box.sql("SELECT count(*) FROM labels JOIN frames USING (frame_id)").rows
        found = box.find("MATCH (e:Ego) WHERE labels.score > $least", least=2.5)

    assert count == [(len(frames),)]
    assert len(found.rows) == sum(row[2] % 7 == 6 for row in frames)


def test_a_table_that_is_none_is_told_by_the_sandbox(path, tmp_path) -> None:
    with pytest.raises(StoreError, match="file not found"):
        Sandbox(path, tables={"labels": tmp_path / "labels.csv"})
