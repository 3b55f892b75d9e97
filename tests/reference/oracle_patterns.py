"""Random queries, most of whose parts mean something in the worlds of ``oracle_worlds``."""

from __future__ import annotations

import random

LABELS = [
    "",
    "",
    "",
    ":Car",
    ":Vehicle",
    ":Lane",
    ":Lane",
    ":Ego",
    ":Vehicle&!Ego",
    ":Car|Person",
    ":Entity",
]
LABELS += [
    ":!Lane",
    ":Person|Ego",
    ":TrafficLight",
    ":StopSign|Signal",
    ":Road",
    ":%",
    ":!(Car|Lane)&!Ego",
]
EDGES = [
    "near",
    "near",
    "near|visible",
    "isIn",
    "isIn",
    "isIn",
    "inDFrontOf|toLeftOf",
    "",
    "%",
    "!near",
]
EDGES += ["opposes", "travelsTo", "controlsTrafficOf", "visible|isIn"]
OF_ENTITIES = ["", "", "", " {speed: 5}", " {special: 'Taxi'}"]
PROPERTIES = dict.fromkeys(("", ":Car", ":Vehicle", ":Entity", ":%"), OF_ENTITIES)
PROPERTIES[":Lane"] = ["", "", " {type: 'driving'}"]


SIMPLE = (
    ("(a:Car)", ["a"]),
    ("(a:Entity)", ["a"]),
    ("(a)-[:near]->(b)", ["a", "b"]),
    ("(a:Vehicle)-[:isIn]->(b:Lane)", ["a", "b"]),
    ("(a:Car), (b:Entity)", ["a", "b"]),
    ("(a:Vehicle)-[:near|visible]-()", ["a"]),
    ("(a:Ego)", ["a"]),
)
"""Patterns that most frames have, and their variables."""


OF_ONE = ("sin", "cos", "tan", "exp", "log", "sqrt", "sign", "degrees", "radians")


class Writer:
    """Writes one query; the same seed writes the same."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = random.Random(seed)
        self.nodes: list[str] = []
        self.egos = 0
        self.edges: list[str] = []

    def query(self) -> str:
        settings = [*self.rng.choice(([], [], ["NODES any"]))]
        settings += [f"EGO 'hero{1 + self.seed // 8 % 2}'"] if self.seed % 8 == 5 else []
        block = self.block("abc", depth=2)
        return f"USING {', '.join(settings)} MATCH {block}" if settings else f"MATCH {block}"

    def block(self, letters: str, depth: int) -> str:
        before = list(self.nodes), list(self.edges)
        nodes = self.rng.choice((1, 2, 2, 3)) if depth == 2 else self.rng.choice((1, 2, 2))
        paths = [self.path(letters, nodes, depth)]
        if self.rng.random() < 0.25:
            paths.append(self.path(letters, 1, depth))
        text = ", ".join(paths)
        if self.rng.random() < 0.75:
            text += f" WHERE {self.condition(depth)}"
        if depth < 2:
            self.nodes, self.edges = before
        return text

    def results(self) -> str:
        """What to return of a query that was just written."""
        names = [name for name in self.nodes if name != "ego"] or ["ego"]
        a, b = self.rng.choice(names), self.rng.choice(names)
        plain = [f"{a}.id", f"{b}.kind", "frame.seq", f"{a}.x + 1", f"{b}.name", "trace.name", a, b]
        plain += ["trace.map", f"{a} = {b}"]
        keys = len(plain)
        plain += [
            f"{a}.speed",
            f"COUNT {{({a})-[:near]->()}}",
            f"EXISTS {{({b})-[:isIn]->(:Lane)}}",
        ]
        if self.rng.random() < 0.1:
            plain += ["ego", "ego.speed", f"dist(ego, {a})", f"COUNT {{(ego)-[:near]-({b})}}"]
        counted = [
            "COUNT(*)",
            f"COUNT({a}.speed)",
            f"COUNT(DISTINCT {b}.id)",
            f"MAX({a}.x)",
            f"AVG({b}.y)",
            f"MIN({a}.kind)",
            f"MAX({b}.name)",
            f"COUNT(DISTINCT {a})",
            f"COUNT(DISTINCT {b})",
            f"COUNT({a})",
        ]
        counted += ["COUNT(DISTINCT ego)"] if self.rng.random() < 0.05 else []
        of_edges = [f"type({edge})" for edge in self.edges]
        plain[:0] = of_edges
        counted += [f"{word}({edge})" for word in ("MIN", "MAX") for edge in of_edges]
        chosen = self.rng.sample(plain, self.rng.choice((1, 2)))
        if self.rng.random() < 0.4:
            chosen = self.rng.sample(plain[: keys + len(of_edges)], self.rng.choice((0, 1, 2)))
            chosen += self.rng.sample(counted, self.rng.choice((1, 2)))
            return f" RETURN {', '.join(chosen)}"
        return f" RETURN {self.rng.choice(('', 'DISTINCT '))}{', '.join(chosen)}"

    def path(self, letters: str, nodes: int, depth: int) -> str:
        text = self.node(letters)
        for _ in range(nodes - 1):
            text += self.edge(depth) + self.node(letters)
        return text

    def node(self, letters: str) -> str:
        roll = self.rng.random()
        name, again = "", False
        if roll < 0.75:
            new = [letter for letter in letters if letter not in self.nodes]
            known = self.nodes if letters != "abc" or self.rng.random() < 0.3 else []
            name = (
                self.rng.choice(known)
                if known and self.rng.random() < 0.6
                else new[0]
                if new
                else ""
            )
            if self.rng.random() < 0.02:
                return "(ego)"
            again = name in self.nodes
            if name and not again:
                self.nodes.append(name)
        label = "" if again and self.rng.random() < 0.9 else self.rng.choice(LABELS)
        if label == ":Ego" and (self.egos or name in self.nodes[:-1]):
            label = ":Car"
        self.egos += label == ":Ego"
        props = self.rng.choice(PROPERTIES.get(label, [""]))
        return f"({name}{label}{props})"

    def edge(self, depth: int) -> str:
        relation = self.rng.choice(EDGES)
        body = f":{relation}" if relation else ""
        roll = self.rng.random()
        if roll < 0.12 and relation not in {"", "%", "!near"}:
            low = self.rng.choice((1, 1, 2))
            body += f"*{low}..{low + self.rng.choice((0, 1))}"
        elif roll < 0.24 and relation == "isIn":
            body += self.rng.choice((" {primary: TRUE}", " {overlap: 0.5}"))
        elif roll < 0.34:
            name = f"d{len(self.edges)}{depth}"
            self.edges.append(name)
            body = name + body
        return self.rng.choice(("-[{}]->", "-[{}]->", "<-[{}]-", "-[{}]-")).format(body)

    def condition(self, depth: int) -> str:
        count = self.rng.choice((1, 1, 2, 2, 3))
        words = self.rng.choice((" AND ", " AND ", " OR ", " XOR "))
        parts = [self.test(depth) for _ in range(count)]
        parts = [f"NOT ({part})" if self.rng.random() < 0.2 else part for part in parts]
        text = words.join(f"({part})" for part in parts)
        if self.rng.random() < 0.1:
            text = f"({text}) IMPLIES ({self.test(depth)})"
        return text

    def test(self, depth: int) -> str:
        nodes = self.nodes or ([] if self.egos else ["ego"])
        if not nodes:
            return f"frame.seq % 2 = {self.rng.choice('01')}"
        if self.rng.random() < 0.04:
            nodes = ["ego", *nodes]
        a, b = self.rng.choice(nodes), self.rng.choice(nodes)
        number = self.rng.choice(("0", "1", "5", "2.5"))
        sign = self.rng.choice(("=", "<>", "<", "<=", ">", ">="))
        tests = [
            lambda: f"{a}.x {sign} {100 + float(number)}",
            lambda: f"{a}.name CONTAINS 'car'",
            lambda: f"{a}.kind IN ['car', 'lane']",
            lambda: f"{a}.kind {self.rng.choice(('=', '<>'))} {b}.kind",
            lambda: f"{a}.heading {sign} {b}.heading + {number}",
            lambda: f"{a}.is_ego",
            lambda: f"{a} {self.rng.choice(('=', '<>'))} {b}",
            lambda: f"{a}.id {sign} {self.rng.choice(('0', '1', '-2'))}",
            lambda: f"frame.seq % 2 = {self.rng.choice('01')}",
            lambda: "trace.name = 'trace1'",
            lambda: f"coalesce({a}.width, 1) {sign} 2",
            lambda: f"{a}.width IS {self.rng.choice(('', 'NOT '))}NULL",
            lambda: f"{a}.is_static",
            lambda: f"abs({a}.y - {b}.y) {sign} {number}",
            lambda: f"{self.rng.choice(OF_ONE)}({a}.y) {self.rng.choice('<>')} {number}",
            lambda: f"{self.rng.choice(('pow', 'atan2'))}({a}.y, {b}.x) > {number}",
            lambda: f"{a}.width IS {self.rng.choice(('', 'NOT '))}KNOWN",
            lambda: f"HAPPENS collision({a if a == b else f'{a}, {b}'})",
            lambda: f"HAPPENS {self.rng.choice((f'lane_invasion({a})', 'environment()'))}",
        ]
        if self.edges and self.rng.random() < 0.3:
            return f"type({self.rng.choice(self.edges)}) {self.rng.choice(('=', '<>'))} 'near'"
        if depth and self.rng.random() < 0.45:
            return self.of_block(depth, sign)
        return self.rng.choice(tests)()

    def of_block(self, depth: int, sign: str) -> str:
        hidden, self.edges = self.edges, []
        inner = self.block("abcuv" if depth == 2 else "abcuvw", depth - 1)
        self.edges = hidden
        roll = self.rng.random()
        if roll < 0.5:
            return self.rng.choice(("EXISTS", "NOT EXISTS")) + f" {{{inner}}}"
        if roll < 0.9:
            return f"COUNT {{{inner}}} {sign} {self.rng.choice('0012')}"
        return f"COUNT {{{inner}}} {sign} COUNT {{(:Car)}}"
