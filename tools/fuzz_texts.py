"""Texts and stores that were hurt: queries, checks, properties in SGL, configs, maps, locks, and stores.

What each of them means is in :data:`LAWS`: a case is made from its seed alone, and looking at it ends in a
result or in an error of sgstore's own, within :data:`SECONDS` of processor time. ``tools/fuzz.py`` runs them
beside recordings.
"""

from __future__ import annotations

import contextlib
import io
import random
import re
import shutil
import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import duckdb
import numpy as np
from fuzz_queries import documented
from recordings import drive

import sgstore
from sgstore.apps.cli import run as command_line
from sgstore.apps.demo import RECORDING
from sgstore.draw import draw_frame
from sgstore.errors import SgstoreError
from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.lang.contrib.sgsm import translated
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import summary
from sgstore.model.config import PRESETS, Config, as_toml, load, preset
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator
from sgstore.testsets.locks import cases_of, read_lock, verify

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.query import Store

TOKEN = re.compile(r"\w+|\s+|[^\w\s]")
ODD_TOKENS = (
    *(
        "(",
        ")",
        "[",
        "]",
        "{",
        "}",
        "->",
        "<-",
        "-",
        "--",
        "*",
        "..",
        ":",
        ";",
        ",",
        "|",
        "&",
        "!",
        "%",
        "$x",
    ),
    *(
        "'",
        '"',
        "''",
        "\\",
        "/*",
        "*/",
        "\x00",
        "\x1b[31m",
        "é",
        "\u202e",
        "\U0001f697",
        "\ud800",
        "\n",
    ),
    *(
        "0",
        "-1",
        "1e308",
        "1e999",
        "9" * 400,
        "NaN",
        "INF",
        "0s",
        "10min",
        "0.1frames",
        "*1..99",
        "0x1f",
    ),
    *(
        "MATCH",
        "WHERE",
        "RETURN",
        "THEN",
        "WITHIN",
        "FOR",
        "CHECK",
        "ALWAYS",
        "NOT",
        "EXISTS {",
        "COUNT {",
    ),
    *(
        "ego",
        "e",
        "v",
        "e.speed",
        "ttc(e, v)",
        "type(r)",
        "frame.t",
        "trace.map",
        "NULL",
        "TRUE",
        "IN [1]",
    ),
    *(
        "AND",
        "OR",
        "UNTIL",
        "[0s, 1s]",
        "DISTINCT",
        "ORDER BY",
        "LIMIT 1",
        "SAMPLE 2 PER",
        "SUBGRAPHS",
        "AS x",
    ),
)
ODD_VALUES = (
    "",
    "-1",
    "0",
    "nan",
    "inf",
    "1e308",
    "-1e308",
    "x",
    "99999999999999999999",
    "1e-300",
    "é",
    "true",
)
QUERIES = (
    "MATCH (e:Ego)-[r:near|visible]->(v:Vehicle) WHERE v.speed > 1 RETURN v.name, COUNT(*) AS n",
    "MATCH (e:Ego), (v:Car) THEN WITHIN 1s MATCH (e), (v) WHERE gap(e, v) < 9 FOR >= 0.2s RETURN CLIPS",
    "CHECK c: FORALL (v:Vehicle) ALWAYS (dist(ego, v) > 1 OR ONCE[0s, 1s] v.speed < 2) RESET WHEN v.speed < 0",
)
SGL = """
from functools import partial
import SG_Primitives as P

lanes = partial(P.relSet, "Ego", "isIn")
others = P.difference(P.relSetR(lanes, "isIn"), "Ego")
red = P.filterByAttr(P.filterByAttr(P.relSetR(lanes, "controlsTrafficOf"), "name", "traffic_light*"),
                     "light_state", "Red")
Property("a", "G((only & ~is_red) -> X (some U fast))",
         {"only": P.eq(P.size(others), 0), "is_red": P.gt(P.size(red), 0),
          "fast": P.eq(P.size(P.filterByAttr("Ego", "carla_speed", lambda x: x > 4)), 1),
          "some": P.gt(P.size(P.union(P.relSet("Ego", "near"), P.relSetR("Ego", "inDFrontOf"))), 1)})
Property("b", "~ $[10][multiple]", [("multiple", P.gt(P.size(lanes), 1))])
"""
SECONDS = 10.0


class Hurt(NamedTuple):
    """How cases of a kind are made and looked at: ``look`` may raise :class:`SgstoreError`, nothing else.

    ``share``: how many cases there are for each of a recording's.
    """

    ending: str
    share: float
    make: Callable[[random.Random, Path], None]
    look: Callable[[Path], None]


# Texts ------------------------------------------------------------------------------------------------------


def hurt_text(text: str, draw: random.Random) -> str:
    """A text after some of its tokens were taken out, doubled, moved or put in other places."""
    tokens = TOKEN.findall(text)
    for _ in range(draw.choice((1, 1, 2, 4, 8))):
        at = draw.randrange(len(tokens) + 1)
        other = draw.randrange(len(tokens) + 1)
        match draw.randrange(8):
            case 0:
                del tokens[at : at + draw.choice((1, 1, 2, 5))]
            case 1:
                tokens[at:at] = tokens[other : other + draw.choice((1, 3, 9))]
            case 2:
                tokens[at : at + 1] = [draw.choice(ODD_TOKENS)]
            case 3:
                tokens[at:at] = [draw.choice(ODD_TOKENS)]
            case 4:
                del tokens[at:]
            case 5:
                tokens[at:at] = [draw.choice(("(", "NOT ", "[", "{", "-"))] * draw.choice(
                    (2, 50, 3000)
                )
            case 6 if tokens:
                word = tokens[min(at, len(tokens) - 1)]
                tokens[at : at + 1] = [word[: len(word) // 2], word[::-1]]
            case _:
                tokens[at:at] = [" "]
    return "".join(tokens)


def write(path: Path, text: str) -> None:
    path.write_bytes(text.encode("utf-8", "surrogatepass"))


def read(path: Path) -> str:
    return path.read_bytes().decode("utf-8", "surrogatepass")


@cache
def _queries() -> tuple[str, ...]:
    return (*QUERIES, *documented())


def make_query(draw: random.Random, path: Path) -> None:
    text = draw.choice(_queries())
    if draw.random() < 0.2:  # two halves of different ones
        text = text[: len(text) // 2] + draw.choice(_queries())[-len(text) // 2 :]
    elif draw.random() < 0.1:  # whole: most of those that are hurt are no queries any more
        write(path, text)
        return
    write(path, hurt_text(text, draw))


def look_at_query(path: Path) -> None:
    text, store = read(path), small()
    try:
        matches = store.find(text)
    except SgstoreError:
        if "CHECK" in text.upper():
            list(store.check(text))
        raise
    next(iter(matches), None)


def make_sgl(draw: random.Random, path: Path) -> None:
    write(path, hurt_text(SGL, draw))


def look_at_sgl(path: Path) -> None:
    translated(read(path))


def make_config(draw: random.Random, path: Path) -> None:
    text = as_toml(preset(draw.choice([*PRESETS])))
    if draw.random() < 0.5:  # a value
        lines = text.split("\n")
        settings = [i for i, line in enumerate(lines) if re.match(r"\w+ = ", line)]
        at = draw.choice(settings)
        name = lines[at].split(" = ")[0]
        value = draw.choice((*ODD_VALUES, "[]", "{}", "[[1]]", "[-1.0, 2]", '"x"'))
        lines[at] = f"{name} = {value}"
        text = "\n".join(lines)
    else:
        text = hurt_text(text, draw)
    write(path, text)


def look_at_config(path: Path) -> None:
    config = load(path)
    with open_trace(_drive()) as trace:
        generator = SceneGraphGenerator(None, config)
        for block in trace.blocks(8):
            generator.block(block)


def make_map(draw: random.Random, path: Path) -> None:
    text = _map_text()
    for _ in range(draw.choice((1, 1, 2, 5))):
        values = list(re.finditer(r'="([^"]*)"', text))
        elements = list(re.finditer(r"<(\w+)[^<>]*/>", text))
        match draw.randrange(5):
            case 0 | 1 if values:
                one = draw.choice(values)
                value = draw.choice((*ODD_VALUES, draw.choice(values)[1]))
                text = f"{text[: one.start(1)]}{value}{text[one.end(1) :]}"
            case 2 if elements:
                one = draw.choice(elements)
                text = text[: one.start()] + text[one.end() :]
            case 3 if elements:
                one, other = draw.choice(elements), draw.choice(elements)
                text = text[: one.start()] + other[0] + text[one.start() :]
            case _:
                at = draw.randrange(len(text))
                text = (
                    text[:at]
                    + draw.choice(("", "<", '"', "&", "\x00", ">"))
                    + text[at + draw.choice((1, 9)) :]
                )
    write(path, text)


def look_at_map(path: Path) -> None:
    """What is read is stood on, summed up and drawn, too; every warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _use_map(path)


def _use_map(path: Path) -> None:
    text = read(path)
    road_map = read_map(text, "hurt")
    nodes = road_map.nodes
    generator = SceneGraphGenerator(road_map, Config())
    for at in range(0, len(nodes), max(len(nodes) // 3, 1)):
        x, y = (float(np.nan_to_num(column[at])) for column in (nodes.x, nodes.y))
        frame = Frame(at * 100_000_000, ego="v0")
        for i in range(6):
            place = {"x": x + 6.0 * i, "y": y + 2.0 * i, "z": 0.0, "heading": 30.0 * i}
            frame.add(f"v{i}", "car", **place, length=4.5, width=1.9, height=1.5, vx=3.0)
        graph = generator.step(frame)
        generator.class_of("RSV")
        generator.roles_of()
        if len(text) % 16 == 0:  # it takes as long as a dozen of the others
            draw_frame(graph, road_map, path.with_suffix(".png"))
    summary(road_map)


def make_lock(draw: random.Random, path: Path) -> None:
    text = _lock_text()
    if draw.random() < 0.6:
        numbers = list(re.finditer(r"(?<=: )[^,{\[\n]+", text))
        one = draw.choice(numbers)
        odd = ("-1", "0", "1e99", "null", '"x"', "[]", "{}", "true", '"../../etc/passwd"', "9" * 30)
        text = text[: one.start()] + draw.choice(odd) + text[one.end() :]
    else:
        text = hurt_text(text, draw)
    write(path, text)


def look_at_lock(path: Path) -> None:
    lock, store = read_lock(path), small()
    list(verify(lock, store))
    cases_of(lock, store)


# Stores -----------------------------------------------------------------------------------------------------

ODD_SQL = (
    "NULL",
    "-1",
    "0",
    "9223372036854775807",
    "'x'",
    "'NaN'",
    "''",
    "repeat('a', 100000)",
    "'\\x00'",
)


def make_store(draw: random.Random, path: Path) -> None:
    shutil.copy(small().file.path, path)
    if draw.random() < 0.4:
        content = bytearray(path.read_bytes())
        for _ in range(draw.choice((1, 1, 8))):
            at = draw.randrange(len(content))
            content[at] ^= draw.randrange(1, 256)
        path.write_bytes(
            content[: draw.choice((len(content),) * 3 + (draw.randrange(len(content)),))]
        )
        return
    with duckdb.connect(str(path)) as connection:
        for _ in range(draw.choice((1, 1, 2))):
            try:
                connection.execute("USE inside")
                connection.execute(_statement(draw, connection))
            except duckdb.Error:
                continue


def _statement(draw: random.Random, connection: duckdb.DuckDBPyConnection) -> str:
    columns = connection.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() WHERE NOT internal ORDER BY ALL"
    ).fetchall()
    table, column, _ = draw.choice(columns)
    kind = draw.choice(("BIGINT", "VARCHAR", "DOUBLE", "BLOB", "BOOLEAN", "INTEGER[]"))
    return draw.choice(
        (
            f'UPDATE {table} SET "{column}" = {draw.choice(ODD_SQL)} WHERE random() < {draw.choice((0.1, 2))}',
            f"DELETE FROM {table} WHERE random() < {draw.choice((0.1, 0.5, 2))}",
            f"INSERT INTO {table} SELECT * FROM {table} LIMIT 3",
            f'ALTER TABLE {table} ALTER "{column}" TYPE {kind}',
            f'ALTER TABLE {table} RENAME "{column}" TO other',
            f'ALTER TABLE {table} DROP "{column}"',
            f"ALTER TABLE {table} RENAME TO other",
            f"DROP TABLE {table} CASCADE",
            f"DROP VIEW {draw.choice(('frames', 'nodes', 'edges', 'pairs', 'payloads'))}",
            f"CREATE OR REPLACE VIEW {draw.choice(('frames', 'nodes', 'edges'))} AS SELECT 1 AS frame_id",
            "CREATE MACRO degrees(x) AS x / 0",
        )
    )


def look_at_store(path: Path) -> None:
    store = sgstore.open(path)
    for ask in (
        store.info,
        lambda: store.find(QUERIES[0]).rows(),
        lambda: list(store.check(QUERIES[2])),
        lambda: store.sql("SELECT count(*), max(speed) FROM nodes").values,
        lambda: store.graph(store.sql("SELECT min(frame_id) FROM frames").values[0][0]),
    ):
        try:
            ask()
        except SgstoreError:
            continue
    assert isinstance(store.file.verify().faults, list)


# What they are made of ----------------------------------------------------------------------------------------


@cache
def _folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="sgstore-hurt-"))


@cache
def _drive() -> Path:
    return drive(_folder() / "drive.mcap", frames=8)


@cache
def small() -> Store:
    """A store of two recordings, one of them with a map."""
    place = _folder() / "small.sgstore"
    ingest(place, [RECORDING, _drive()], until=3.0)
    return sgstore.open(place)


@cache
def _map_text() -> str:
    with open_trace(RECORDING) as trace:
        return trace.info.map_text


@cache
def _lock_text() -> str:
    place = _folder() / "small.lock"
    given = ["select", str(small().file.path), "--minimal", "--unit", "clip", "-o", str(place)]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert command_line(given) == 0
    return place.read_text()


LAWS: dict[str, Hurt] = {
    "query": Hurt(".sgql", 1, make_query, look_at_query),
    "sgl": Hurt(".py", 1, make_sgl, look_at_sgl),
    "config": Hurt(".toml", 1, make_config, look_at_config),
    "map": Hurt(".xodr", 1, make_map, look_at_map),
    "lock": Hurt(".lock", 0.3, make_lock, look_at_lock),
    "store": Hurt(".sgstore", 0.1, make_store, look_at_store),
}


def look(kind: str, seed: int, path: Path) -> str:
    """Make the case of a seed and look at it: ``whole`` or ``error``. Other errors are raised."""
    law = LAWS[kind]
    law.make(random.Random(f"{kind} {seed}"), path)
    try:
        law.look(path)
    except SgstoreError as error:
        return "error" if str(error) else "an error without words"
    return "whole"
