"""What a query is not taken for, and how a message shows where it is wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from test_lang_golden import CATALOG

from sgstore.errors import QueryError, TextSpan
from sgstore.lang.sql import compile_checks, compile_query, for_people


def refused(text: str, **parameters: object) -> QueryError:
    with pytest.raises(QueryError) as error:
        compile_query(text, CATALOG, parameters)
    return error.value


def sql(text: str, **parameters: object) -> str:
    return compile_query(text, CATALOG, parameters).rows().sql


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (a:Car)-->b",
        "MATCH (a:Car) --> b",
        "MATCH (a:Car)--b",
        "MATCH (a:Car)--[:near]->(b)",
        "MATCH (a:Car) --[:near]->(b)",
        "MATCH (a:Car) WHERE a.speed > 3 AND (a)-->(b)",
    ],
)
def test_misspelt_edge_is_not_a_comment(text: str) -> None:
    assert refused(text).span is not None


@pytest.mark.parametrize("blank", ["", " ", "  ", "\t"])
def test_edge_of_two_dashes_may_have_blanks(blank: str) -> None:
    assert sql(f"MATCH (a:Car){blank}--{blank}(b:Car)") == sql("MATCH (a:Car)--(b:Car)")


@pytest.mark.parametrize("comment", [" -- b", " --b", "\n--\n", " ------", " --- >", " -- a --> b"])
def test_comments_stay_comments(comment: str) -> None:
    assert sql(f"MATCH (a:Car){comment}") == sql("MATCH (a:Car)")


def test_node_named_ego_is_the_ego_with_any_label() -> None:
    inside = "MATCH (p:Person) WHERE EXISTS {{(ego:{})-[:near]->(p)}}"

    assert sql("MATCH (ego:Car)-[:near]->(p:Person)") == sql(
        "MATCH (ego:Car&Ego)-[:near]->(p:Person)"
    )
    assert sql(inside.format("Car")) == sql(inside.format("Car&Ego"))
    assert "exclude each other" in refused("MATCH (ego:Lane)").reason


def test_label_without_colon_is_not_a_name() -> None:
    assert "(:Car)" in str(refused("MATCH (Car)"))
    assert "-[:near]->" in str(refused("MATCH (a)-[near]->(b)"))
    assert sql("MATCH (car)-[near:near]->(b)")
    assert sql("MATCH (Car:Car)-[:near]->(b), (Car)-[:near]->(c)")


def test_count_is_equal_with_and_without_distinct() -> None:
    query = "MATCH (e:Ego)-[:near]->(p:Person) RETURN {} p.name AS who, COUNT(*) AS n, AVG(p.speed)"

    assert sql(query.format("DISTINCT")) == sql(query.format(""))


@pytest.mark.parametrize("text", ["[[:alpha:]]+", "[[a]", "[a&&b]", "[a--b]", "[a||b]", "[a~~b]"])
def test_nested_regex_set_is_refused(text: str) -> None:
    assert "a set contains a set" in refused(f"MATCH (v:Car) WHERE v.ident =~ '{text}'").reason
    escaped = text[0] + text[1:].replace("[", r"\\[")
    if "[[" in text:
        assert sql(f"MATCH (v:Car) WHERE v.ident =~ '{escaped}'")


def test_list_is_not_a_row_value() -> None:
    error = refused("MATCH (a:Car) RETURN a.speed, [1, 2] AS both")

    assert error.reason == "a list cannot be returned"
    assert error.span is not None


def test_prev_takes_only_values() -> None:
    error = refused("MATCH (v:Vehicle) WHERE prev(v) = 3")

    assert error.reason == "prev() takes a value, not a node"
    assert error.span is not None
    assert error.span.start == len("MATCH (v:Vehicle) WHERE prev(")


@pytest.mark.parametrize("form", ["INTERVALS", "CLIPS(-1s, +1s)", "p.id, INTERVALS"])
def test_intervals_are_distinct(form: str) -> None:
    query = "MATCH (e:Ego)-[:near]->(p:Person) RETURN {} {} SAMPLE 3"

    assert sql(query.format("DISTINCT", form)) == sql(query.format("", form))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400])
def test_parameter_is_limited_to_numbers_of_the_language(value: float) -> None:
    assert "expected a number" in refused("MATCH (e:Ego) WHERE e.speed > $v", v=value).reason


def test_integer_too_large_for_the_database_is_a_number() -> None:
    statement = compile_query("MATCH (e:Ego) WHERE e.speed > $v", CATALOG, {"v": 2**70}).rows()

    assert 2.0**70 in statement.values
    assert all(isinstance(value, float) for value in statement.values if value == 2**70)


@pytest.mark.parametrize(
    ("text", "line", "carets"),
    [
        ("a\tbad", "  a bad", "    ^^^"),
        ("'自動車' bad", "  '自動車' bad", "           ^^^"),
        ("'e\u0301' bad", "  'e\u0301' bad", "      ^^^"),
        ("a\x00bad", "  a·bad", "    ^^^"),
        ("\x1b[31m bad", "  ·[31m bad", "        ^^^"),
        ("one\r\ntwo\u2028 bad\r\nthree", "  two  bad ", "       ^^^"),
    ],
)
def test_carets_mark_the_error(text: str, line: str, carets: str) -> None:
    start = text.index("bad")

    message = str(QueryError("no", text=text, span=TextSpan(start, start + 3)))

    assert message.split("\n") == ["no", line, carets]


@pytest.mark.parametrize("at", [0, 70, 5_000, 9_990])
def test_long_line_is_cut_around_the_error(at: int) -> None:
    text = "x " * 5_000
    text = f"{text[:at]}bad {text[at:]}"

    _, line, carets = str(QueryError("no", text=text, span=TextSpan(at, at + 3))).split("\n")

    assert len(line) < 170
    assert line[carets.index("^") : carets.index("^") + 3] == "bad"


def test_unexpected_text_is_short_and_visible() -> None:
    assert "U+0000" in refused("MATCH (e:Ego)\0").reason
    assert "U+200B" in refused("MATCH (e:Ego)\u200b").reason
    assert len(refused(f"MATCH (e:Ego) {'x' * 50_000}").reason) < 200


def test_named_columns_are_displayed() -> None:
    columns = ("frame_id", "trace", "seq", "time_ns", "t", "v", "v.name", "p.id", "q.name")

    shown, rows = for_people(
        columns, [(7, "a", 3, 1, 0.12345, 5, "car 5", 8, "car 9")], graphs=False
    )

    assert shown == ("frame", "t", "v", "p.id", "q.name")
    assert list(rows) == [("a#3", 0.123, "car 5", 8, "car 9")]


def test_displayed_intervals_begin_with_first_frame() -> None:
    columns = (
        "trace",
        "start_seq",
        "end_seq",
        "start_ns",
        "end_ns",
        "start",
        "end",
        "frames",
        "who",
    )

    shown, rows = for_people(columns, [("a", 3, 5, 1, 2, 0.1, 0.3, 3, "x")], graphs=False)

    assert shown == ("from", "start", "end", "frames", "who")
    assert list(rows) == [("a#3", 0.1, 0.3, 3, "x")]


DIGITS = "9" * 400


@pytest.mark.parametrize(
    "text",
    [
        f"MATCH (e:Ego) WHERE e.speed > {DIGITS}",
        f"MATCH (e:Ego) WHERE e.speed > {DIGITS}.5",
        f"MATCH (e:Ego) FOR >= {DIGITS}s",
        f"MATCH (e:Ego) FOR >= {DIGITS}.5min",
        f"MATCH (e:Ego) FOR >= {DIGITS}frames",
        f"MATCH (e:Ego) WHERE delta(e.speed, {DIGITS}.5s) > 1",
        f"MATCH (e:Ego) WHERE ONCE[0s,{DIGITS}s] e.speed > 1",
        f"MATCH (e:Ego) WHERE ONCE[{DIGITS}ms,INF] e.speed > 1",
        f"MATCH (e:Ego) THEN WITHIN {DIGITS}s MATCH (e)",
        f"MATCH (e:Ego) LIMIT {DIGITS}",
        f"MATCH (e:Ego) RETURN CLIPS(-{DIGITS}s, +1s)",
    ],
)
def test_number_of_400_digits_is_refused_at_its_place(text: str) -> None:
    error = refused(text)

    assert str(error).startswith(
        ("the number is too large", "this duration is longer than any trace")
    )


@pytest.mark.parametrize("value", [10**400, 1e300, -1e300, f"{DIGITS}s", f"{DIGITS}frames"])
def test_parameter_with_invalid_duration_is_refused(value: object) -> None:
    assert "this duration is longer than any trace" in str(
        refused("MATCH (e:Ego) FOR >= $p", p=value)
    )


@pytest.mark.parametrize(
    "text",
    [
        "CHECK FORALL (v:Vehicle) ALWAYS NOT (ego)-[:near]->(v)",
        "CHECK FORALL (v:Vehicle) ALWAYS ((v)-[:near]->(ego) IMPLIES v.speed < 3)",
    ],
)
def test_an_edge_without_braces_after_forall_needs_exists(text: str) -> None:
    with pytest.raises(QueryError) as error:
        compile_checks(text, CATALOG)

    assert "in braces: EXISTS {(a)-[:near]->(b)}" in str(error.value)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("ahead", "write the predicate as ahead(a, b); did you mean 'inDFrontOf'?"),
        ("behind", "write the predicate as behind(a, b); did you mean 'atDRearOf'?"),
        ("neer", "did you mean 'near'?"),
    ],
)
def test_unknown_relation_names_the_predicate_of_its_name(name: str, hint: str) -> None:
    assert refused(f"MATCH (e:Ego)-[:{name}]->(v)").hint == hint


NO_EGO = "so (:Ego) in braces matches nothing there"


@pytest.mark.parametrize(
    ("text", "noted"),
    [
        ("MATCH (v:Car) WHERE NOT EXISTS {(e:Ego)-[:near]->(v)}", True),
        ("MATCH (v:Car) WHERE NOT EXISTS {(e:Ego)}", True),
        ("MATCH (v:Car) RETURN COUNT {(e:Ego)-[:near]->(v)} AS n", True),
        ("MATCH (v:Car) WHERE NOT EXISTS {(p:Person) WHERE EXISTS {(:Ego)-[:near]->(p)}}", True),
        ("MATCH (v:Car) WHERE NOT EXISTS {(e:Ego)-[:near]->(v)} THEN MATCH (v:Car)", True),
        ("MATCH (v:Car) WHERE prev(v.speed) > 3 AND NOT EXISTS {(e:Ego)-[:near]->(v)}", True),
        ("MATCH (v:Car) WHERE NOT EXISTS {(w:Car)-[:near]->(v)}", False),
        ("MATCH (v:Car) WHERE NOT EXISTS {(ego)-[:near]->(v)}", False),
        ("MATCH (e:Ego), (v:Car) WHERE NOT EXISTS {(o:Ego)-[:near]->(v)}", False),
    ],
)
def test_ego_in_braces_has_a_note_on_traces_without_an_ego(text: str, noted: bool) -> None:
    trace, *_ = CATALOG.traces
    names = dict(enumerate(("with", "without", "neither"), 1))
    egos = {1: "7", 2: "", 3: ""}
    traces = tuple(replace(trace, trace_id=n, name=names[n], ego=egos[n]) for n in names)

    def notes(*chosen: int) -> list[str]:
        catalog = replace(CATALOG, traces=traces, only=frozenset(chosen))
        return [one for one in compile_query(text, catalog).bound.doubts if NO_EGO in one]

    assert notes(1) == []
    one = [f"1 trace has no ego, {NO_EGO}: without"]
    assert notes(1, 2) == one * noted
    assert notes(1, 2, 3) == [f"2 traces have no ego, {NO_EGO}: without, neither"] * noted
