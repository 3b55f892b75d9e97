"""The grammar, its tables, and what the parser makes of texts."""

from __future__ import annotations

import re
from importlib import resources
from typing import TYPE_CHECKING

import pytest
from lark import Lark, UnexpectedInput

import sgstore.lang.syntax._tables as tables
from sgstore.errors import QuerySyntaxError
from sgstore.lang.sql._explain import statements_text, tree_text
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.lang.syntax._parse import MAX_DEPTH, MAX_LENGTH
from sgstore.lang.syntax._tree_builder import BUILDERS

if TYPE_CHECKING:
    from pathlib import Path

LANG = resources.files("sgstore.lang.syntax")
GRAMMAR = LANG.joinpath(tables.GRAMMAR).read_text(encoding="utf-8")

SENTENCES = [
    "MATCH (e:Ego)-[:near]->(p:Person)",
    "USING NODES any, EGO 'x' MATCH (a), (b) WHERE a.speed > 1 OR NOT b.speed <= 2 XOR a = b",
    "MATCH (a:Car|!Bus&%)<-[r:isIn*1..3]-(b {speed: -3.5e2, special: 'taxi'})-[]-(c)",
    "MATCH (a)-[:near]->{1,3}(b)-[:near]->{2}(c)",
    "MATCH (a) WHERE EXISTS {MATCH (a)-[:near]->(b) WHERE b.speed > 3} AND COUNT {(a)} * 2 % 3 = 1",
    "MATCH (a) WHERE MIN {(a)-[:near]->(b) | b.speed} < $limit RETURN min(a.x, 3), MIN {(b) | b.x}",
    "MATCH (a) RETURN DISTINCT a.x AS x, COUNT(*) ORDER BY x DESC, a.y ASC SAMPLE 3 PER a.z LIMIT 5",
    "MATCH (a) WHERE a.name STARTS WITH 'a' AND a.name ENDS WITH \"b\" OR a.name =~ 'c' LIMIT 3",
    "MATCH (a) WHERE a.x IS NULL => a.y IS NOT NULL IMPLIES a.id NOT IN [1, 2, $x] RETURN CLIPS(-3s, +5s)",
    "DEFINE PREDICATE f(x) AS x.speed < 1; DEFINE SCENARIO g() AS MATCH (a); MATCH (a) WHERE f(a);",
    "MATCH (a) WHERE a.x > 1 FOR >= 2s AS slow THEN AFTER 1s WITHIN 2s NOT MATCH (b) UNTIL MATCH (a)",
    "CHECK c: FORALL (v:Car, w:Bus WHERE v.x > w.x) ALWAYS[0s, INF] (v.x > 1 UNTIL w.x < 2) RESET WHEN TRUE",
    "MATCH (a) WHERE ALWAYS WITHIN 3s a.x > 1 SINCE [1s, 2s] a.y < 2",
]
NO_SENTENCES = [
    "",
    "MATCH",
    "MATCH (a",
    "MATCH (a)-[:near](b)",
    "MATCH (a) WHERE",
    "MATCH (a) WHERE a.x >",
    "MATCH (a) RETURN",
    "MATCH (a) LIMIT x",
    "MATCH (a:Car&)",
    "MATCH (a) WHERE a.x IS 3",
    "MATCH (a) WHERE (a.x > 3",
    "RETURN 3",
    "MATCH (a) (b)",
]


def test_shipped_tables_match_the_grammar() -> None:
    kept = LANG.joinpath(tables.TABLES).read_text(encoding="utf-8")

    made = tables.text_of(tables.made_from(GRAMMAR))

    assert kept == made, "run: python -m sgstore.lang.syntax._tables"


def test_grammar_rules_and_builders_match() -> None:
    names = {rule.name for rule in tables.tables().rules if not rule.name.startswith("_")}
    inlined = {rule.name for rule in tables.tables().rules if rule.inline}

    assert names - inlined <= set(BUILDERS)
    assert set(BUILDERS) <= names


@pytest.mark.parametrize("text", SENTENCES)
def test_lark_accepts_every_accepted_text(text: str) -> None:
    lark().parse(text)

    assert parse(text)


@pytest.mark.parametrize("text", NO_SENTENCES)
def test_lark_refuses_every_refused_text(text: str) -> None:
    with pytest.raises(UnexpectedInput):
        lark().parse(text)
    with pytest.raises(QuerySyntaxError):
        parse(text)


@pytest.mark.data
def test_every_example_is_accepted(data: Path) -> None:
    proposal = data.parent / "reference" / "applications.md"
    if not proposal.is_file():
        pytest.skip("the proposal is not there")
    blocks = re.findall(r"```sgql\n(.*?)```", proposal.read_text(encoding="utf-8"), re.DOTALL)

    statements = [statement for block in blocks for statement in parse(block)]

    assert len(statements) > 100


@pytest.mark.parametrize(
    ("other", "own"),
    [
        ("GLOBALLY[0s, 2s] e.x > 1", "ALWAYS[0s, 2s] e.x > 1"),
        ("finally e.x > 1", "EVENTUALLY e.x > 1"),
        ("NEVER[0s, 2s] e.x > 1", "ALWAYS[0s, 2s] NOT e.x > 1"),
        ("e.x > 1 UNLESS[0s, 2s] e.y", "e.y RELEASE[0s, 2s] (e.x > 1 OR e.y)"),
    ],
)
def test_operators_of_other_tools_are_synonyms(other: str, own: str) -> None:
    def tree(text: str) -> str:
        return tree_text(parse(f"CHECK c: {text}")[0])

    assert tree(other) == tree(own)


def test_keyword_is_a_name_at_other_places() -> None:
    (match,) = parse("match (limit:Car) where limit.frames > 3 return limit.match as match")

    assert isinstance(match, s.MatchClause)
    assert match.block.paths[0].nodes[0].name == "limit"
    assert match.returns is not None
    assert match.returns.items[0].name == "match"


def test_comments_and_edges_are_distinguished() -> None:
    (match,) = parse("MATCH (a)--(b)-->(c)<--(d) -- a comment (e)\n, (f) /* and\n(g) */ , (h) --")

    assert isinstance(match, s.MatchClause)
    assert [len(path.nodes) for path in match.block.paths] == [4, 1, 1]
    assert [e.direction for e in match.block.paths[0].edges] == ["any", "right", "left"]


def test_operator_precedence() -> None:
    (match,) = parse("MATCH (a) WHERE 1 + 2 * 3 - -4 = 11 AND TRUE OR NOT FALSE AND TRUE")

    assert isinstance(match, s.MatchClause)
    where = match.block.where
    assert isinstance(where, s.Logic)
    assert where.word == "OR"
    assert isinstance(where.operands[0], s.Logic)
    comparison = where.operands[0].operands[0]
    assert isinstance(comparison, s.Comparison)
    assert isinstance(comparison.left, s.Arithmetic)
    assert [sign for sign, _ in comparison.left.rest] == ["+", "-"]


def test_texts_keep_escaped_characters() -> None:
    (match,) = parse(r"""MATCH (a) WHERE a.name IN ['it\'s', "a\"b", 'c\\d', 'e\nf']""")

    assert isinstance(match, s.MatchClause)
    assert isinstance(match.block.where, s.Membership)
    assert isinstance(match.block.where.choices, s.ListOf)
    values = [
        item.value for item in match.block.where.choices.items if isinstance(item, s.Constant)
    ]
    assert values == ["it's", 'a"b', "c\\d", "e\nf"]


def test_spans_cover_the_parts_of_the_text() -> None:
    text = "MATCH (e:Ego)-[d:near]->(p) WHERE dist(e, p) < 15"

    (match,) = parse(text)

    assert isinstance(match, s.MatchClause)
    where = match.block.where
    assert isinstance(where, s.Comparison)
    assert text[where.span.start : where.span.end] == "dist(e, p) < 15"
    assert isinstance(where.left, s.Call)
    assert text[where.left.name_span.start : where.left.name_span.end] == "dist"
    edge = match.block.paths[0].edges[0]
    assert text[edge.span.start : edge.span.end] == "-[d:near]->"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("MATCH (a) WHERE " + "(" * (MAX_DEPTH + 1), id="parentheses"),
        pytest.param("MATCH (a) WHERE " + "NOT " * (MAX_DEPTH + 1) + "TRUE", id="negations"),
        pytest.param("MATCH (a) WHERE " + "EXISTS {(a) WHERE " * MAX_DEPTH, id="blocks"),
        pytest.param("MATCH (a)" + " " * MAX_LENGTH, id="length"),
    ],
)
def test_depth_and_length_are_bounded(text: str) -> None:
    with pytest.raises(QuerySyntaxError, match=r"nested too deeply|characters, more than"):
        parse(text)


def test_many_terms_are_not_nested() -> None:
    text = "MATCH (a) WHERE " + " AND ".join(["1 + 1 + 1 = 3"] * 2000)

    (match,) = parse(text)

    assert isinstance(match, s.MatchClause)
    assert isinstance(match.block.where, s.Logic)
    assert len(match.block.where.operands) == 2000


def test_tree_is_printed_without_spans() -> None:
    printed = tree_text(parse("MATCH (e:Ego) WHERE e.speed > 3")[0])

    assert "NodePattern name='e'" in printed
    assert "span" not in printed


def lark() -> Lark:
    """Lark's own parser of the same grammar: who else reads it, and blanks and comments, which ours skips."""
    if not PARSERS:
        more = "\n%ignore /\\s+/\n%ignore /--[^\\n]*|\\/\\*(.|\\n)*?\\*\\//\n"
        PARSERS.append(Lark(GRAMMAR + more, parser="lalr", maybe_placeholders=True))
    return PARSERS[0]


PARSERS: list[Lark] = []


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (e:Ego) WHERE e.speed < 1.5 -- metres, a second\n AND e.x > 1",
        "MATCH (e:Ego) WHERE e.speed --, of the ego\n < 1.5 AND e.x > -- east\n 1",
        "MATCH (e:Ego) -- comment, here\n WHERE e.speed < 1.5 AND e.x > 1 --, no more",
    ],
)
def test_two_dashes_in_an_expression_begin_a_comment(text: str) -> None:
    plain = "MATCH (e:Ego) WHERE e.speed < 1.5 AND e.x > 1"

    assert statements_text(parse(text)) == statements_text(parse(plain))


def test_two_dashes_between_nodes_are_an_edge() -> None:
    assert statements_text(parse("MATCH (a)--(b)")) != statements_text(parse("MATCH (a), (b)"))
