"""Fields of topics in patterns and checks: names, types, errors, and values by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from sgstore.errors import QueryError
from sgstore.lang.bind import bind_checks, bind_query
from sgstore.lang.catalog import Catalog, TopicFacts, TopicField, TopicValue, Type
from sgstore.lang.ir import FrameAttribute, walk
from sgstore.lang.syntax import parse

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.lang.ir import Query

FIELDS: Mapping[str, Mapping[str, str]] = {
    "/planner": {
        "state": "VARCHAR",
        "active": "BOOLEAN",
        "values": "DOUBLE[]",
        "raw": "BLOB",
        "more.any": "JSON",
        "odd-name": "INTEGER",
    },
    "/imu": {f"linear_acceleration.{axis}": "DOUBLE" for axis in "xyz"},
}


def _facts(name: str, refused: str = "") -> TopicFacts:
    fields = {field: TopicField(field, kind) for field, kind in FIELDS.get(name, {}).items()}
    return TopicFacts(name, frozenset({1}), stored=True, refused=refused, source=lambda: fields)


STORE = Catalog(
    topics={
        **{name: _facts(name) for name in FIELDS},
        "/lidar": _facts("/lidar", "its encoding is 'cbor'"),
    }
)
ONLINE = Catalog(online=True)
HEAD = "MATCH (e:Ego) WHERE "


def bound(text: str, catalog: Catalog = STORE, **values: object) -> Query:
    return bind_query(text, parse(text), catalog, values)


def values_of(query: Query) -> list[FrameAttribute]:
    parts = (*query.scope.where, *query.result.values)
    return [one for part in parts for one in walk(part) if isinstance(one, FrameAttribute)]


@pytest.mark.parametrize(
    ("written", "meant", "kind"),
    [
        ("topic('/planner').state", TopicValue("/planner", "state"), Type.text),
        ("topic('planner').active", TopicValue("/planner", "active"), Type.boolean),
        ("topic('/planner').`odd-name`", TopicValue("/planner", "odd-name"), Type.number),
        ("topic('/planner').values[2]", TopicValue("/planner", "values[2]"), Type.number),
        (
            "topic('/imu', nearest, 0.1s).linear_acceleration.z",
            TopicValue("/imu", "linear_acceleration.z", "nearest", 100_000_000),
            Type.number,
        ),
        (
            "topic('/imu', LINEAR, INF).Linear_Acceleration.X",
            TopicValue("/imu", "linear_acceleration.x", "linear", None),
            Type.number,
        ),
        (
            "topic('/imu', 20ms).linear_acceleration.z",
            TopicValue("/imu", "linear_acceleration.z", "last", 20_000_000),
            Type.number,
        ),
    ],
)
def test_topic_fields_have_type_rule_and_tolerance(
    written: str, meant: TopicValue, kind: Type
) -> None:
    (value,) = values_of(bound(f"MATCH (e:Ego) RETURN {written}"))
    assert (value.attribute.topic, value.type) == (meant, kind)
    (again,) = values_of(bound(f"MATCH (e:Ego) RETURN {meant.written}"))
    assert again == value


def test_using_tolerance_is_the_default_of_a_statement() -> None:
    text = "MATCH (e:Ego) RETURN topic('/imu').linear_acceleration.z"
    for setting, ns in (
        ("0.5s", 500_000_000),
        ("20ms", 20_000_000),
        ("2", 2 * 10**9),
        ("INF", None),
    ):
        (value,) = values_of(bound(f"USING TOLERANCE {setting} {text}"))
        assert value.attribute.topic == TopicValue("/imu", "linear_acceleration.z", "last", ns)
    (value,) = values_of(bound(f"USING TOLERANCE $t {text}", t="3s"))
    assert value.attribute.topic == TopicValue("/imu", "linear_acceleration.z", "last", 3 * 10**9)


@pytest.mark.parametrize(
    ("condition", "reason", "marked", "hint"),
    [
        (
            "topic('/planer').state = 'A'",
            "no topic '/planer'",
            "'/planer'",
            "did you mean '/planner'?",
        ),
        (
            "topic('/planner').stat = 'A'",
            "topic '/planner' has no field 'stat'",
            "stat",
            "did you mean 'state'?",
        ),
        (
            "topic('/imu').linear_acceleration > 1",
            "topic '/imu' has no field 'linear_acceleration'",
            "linear_acceleration",
            "it has linear_acceleration.x, ",
        ),
        (
            "topic('/lidar').x > 1",
            "topic '/lidar' cannot be decoded: its encoding is 'cbor'",
            "'/lidar'",
            None,
        ),
        (
            "topic('/planner').state > 1",
            "a text cannot be compared with a number",
            "topic('/planner').state > 1",
            "write a text in quotes: '1'",
        ),
        (
            "topic('/planner').values > 1",
            "field values of /planner has several values",
            "values",
            "one of them: values[0]",
        ),
        (
            "topic('/planner').raw IS KNOWN",
            "field raw of /planner has bytes, not one value",
            "raw",
            "in SQL, \"raw\" is a column of topic('/planner')",
        ),
        (
            "topic('/planner').more.any = 'A'",
            "field more.any of /planner has JSON values, not one value",
            "more.any",
            "in SQL, \"more.any\" is a column of topic('/planner')",
        ),
        (
            "topic('/planner', linear).state = 'A'",
            "only numbers can be interpolated, and state is a text",
            "topic('/planner', linear).state",
            "write topic('/planner', nearest)",
        ),
        (
            "topic('/planner') = 'A'",
            "a message of a topic is not a value",
            "topic('/planner')",
            "write one of its fields: topic('/imu').angular_velocity.z",
        ),
        (
            "topic('/planner', first).state = 'A'",
            "unknown rule 'first' of topic(); expected last, nearest, linear",
            "topic('/planner', first)",
            None,
        ),
        (
            "topic('/planner', 3frames).state = 'A'",
            "topic() takes a name, a rule and a time",
            "topic('/planner', 3frames)",
            "topic('/imu', nearest, 0.1s).linear_acceleration.z",
        ),
        (
            "e.`speed` > 1",
            "only fields of a topic are written as `speed`",
            "`speed`",
            "topic('/name').`speed`",
        ),
    ],
)
def test_errors_have_the_place_and_the_nearest_name(
    condition: str, reason: str, marked: str, hint: str | None
) -> None:
    text = HEAD + condition
    with pytest.raises(QueryError) as caught:
        bound(text)
    error = caught.value
    assert error.reason == reason
    assert error.span is not None
    assert text[error.span.start : error.span.end] == marked
    assert (error.hint or "").startswith(hint or "")


def test_types_of_unknown_topics_follow_from_their_place() -> None:
    """A monitor learns the topics only from its frames."""
    for condition, kind in (
        ("topic('/a').b = 'STOP'", Type.text),
        ("3 < topic('/a').b", Type.number),
        ("topic('/a').b", Type.boolean),
        ("topic('/a').b IN ['x']", Type.text),
        ("lower(topic('/a').b) = 'x'", Type.text),
        ("coalesce(topic('/a').b, 3) > 2", Type.number),
        ("topic('/a').b IS NULL", Type.open),
    ):
        (value,) = values_of(bound(HEAD + condition, ONLINE))
        assert value.type is kind, condition
    with pytest.raises(QueryError, match="no topic '/planer'"):
        bound(HEAD + "topic('/planer').state = 'A'", Catalog(online=True, topics=STORE.topics))


def test_checks_bind_topics_in_every_place() -> None:
    text = (
        "CHECK c: FORALL (v:Vehicle WHERE topic('/planner').active)"
        " ALWAYS (min_over(topic('/imu').linear_acceleration.z, 1s) < 3"
        " AND prev(topic('/planner').state) = 'GO'"
        " IMPLIES EVENTUALLY[0s, 2s] topic('/planner').state = 'STOP')"
        " RESET WHEN topic('/planner').active ROBUSTNESS"
        " RETURN MAX(topic('/imu').linear_acceleration.x) OVER match"
    )
    (check,) = bind_checks(text, parse(text), lambda _: STORE, {})
    assert check.check.name == "c"
    (check,) = bind_checks(text, parse(text), lambda _: ONLINE, {})
    assert check.check.robustness
