"""Write ``docs/api.md`` from the docstrings of the public names, and ``docs/relations.md``: ``make api``."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from textwrap import dedent
from typing import Any

import sgstore
from sgstore.graphs.relations import as_markdown
from sgstore.query import StoreVerbs
from sgstore.store import Tabular

PAGE = Path(__file__).parents[1] / "docs" / "api.md"

PARTS: dict[str, tuple[str, ...]] = {
    "A store": ("open", "Store", "StoreFrame", "duckdb"),
    "A collection of stores": ("Collection",),
    "Answers": (
        *("Matches", "Interval", "Clip", "ClipAnimation", "FrameRef"),
        *("Rows", "CheckRun", "Verdict"),
    ),
    "Graphs and patterns": ("SceneGraph", "Pattern"),
    "Online": ("Config", "Frame", "SceneGraphGenerator", "Monitor", "read_map_file"),
    "Errors": (
        *("SgstoreError", "TraceError", "MapError", "ConfigError", "StoreError", "SqlError"),
        *("QueryError", "AbstractionError", "ExportError", "MissingExtraError"),
    ),
}

LEFT_OUT = {
    "Store": {"catalog", "info"},
    "Matches": {"as_table", "for_people"},
    "Collection": {"ask", "bundles", "catalog", "classes", "engine", "info", "may_answer"},
    "Config": {"unknown", "mapped"},
}
"""Public methods that are for other parts of sgstore."""

HEAD = """\
# The Python API

<!-- Written by `make api` from the docstrings. Change these, not this page. -->

Everything on this page is imported from `sgstore`. A name is loaded when it is used, so that the
import costs nothing.

```python
import sgstore

with sgstore.open("drives.sgstore", create=True) as store:
    store.ingest("recordings/")  # files, folders, patterns
    matches = store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)")
    print(matches.count(), "frames")
    for row in matches.limit(10):
        print(row.trace, row.t, row.p_name)
    table = matches.df()  # or polars(), arrow()
    verdicts = list(store.check("CHECK slow: ALWAYS ego.speed < 14"))
    graph = store.graph("town#264")  # networkx
    picture = store.picture("town#264", "/ego/camera/front/image")  # Pillow
    store.show("town#264").save("frame.png")
```

You can repeat the examples: `store` is `sgstore.open("demo.sgstore")`, which `sgstore demo .` writes.
`sgstore collection pack demo.sgstore fleet` makes the collection `fleet`.
"""


def page() -> str:
    """The text of the page."""
    lines = [HEAD]
    for title, names in PARTS.items():
        lines.append(f"## {title}\n")
        for name in names:
            lines += described(name, getattr(sgstore, name), "###")
            if inspect.isclass(getattr(sgstore, name)):
                for method, held in members(name):
                    lines += described(f"{name}.{method}", held, "####")
    return "\n".join(lines).rstrip() + "\n"


def members(name: str) -> list[tuple[str, Any]]:
    """Public methods and properties of a class, and those of its documented base class."""
    kind = getattr(sgstore, name)
    found: list[tuple[str, Any]] = []
    shared = vars(Tabular) if issubclass(kind, Tabular) else {}
    shared = vars(StoreVerbs) if name == "Store" else shared
    for key, held in (vars(kind) | shared).items():
        one = getattr(held, "__func__", held)
        method = inspect.isfunction(one) or isinstance(held, property)
        if method and not key.startswith("_") and key not in LEFT_OUT.get(name, ()):
            found.append((key, held))
    return found


def described(name: str, held: Any, level: str) -> list[str]:
    """Heading, signature and documentation of a name."""
    lines = [f"{level} {name}\n"]
    if not isinstance(held, property) and not (
        inspect.isclass(held) and issubclass(held, Exception)
    ):
        lines.append(f"```text\n{signature(name, held)}\n```\n")
    documentation = markdown(inspect.getdoc(held) or "")
    return [*lines, documentation, ""]


def signature(name: str, held: Any) -> str:
    """``Store.graph(frame, abstraction=None)``, without types: these are in the text."""
    function = getattr(held, "__func__", held)
    parts: list[str] = []
    star = False
    for one in inspect.signature(function).parameters.values():
        if one.name == "self" or one.name.startswith("_"):
            continue
        if one.kind is one.KEYWORD_ONLY and not star:
            parts.append("*")
            star = True
        mark = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        star = star or one.kind is one.VAR_POSITIONAL
        parts.append(f"{mark}{one.name}{default_text(one.default)}")
    whole = f"{name}({', '.join(parts)})"
    if len(whole) <= 100:
        return whole
    return f"{name}(\n    " + ",\n    ".join(parts) + ",\n)"


def default_text(default: Any) -> str:
    if default is inspect.Parameter.empty:
        return ""
    plain = isinstance(default, (int, float, str, bool, tuple)) or default is None
    return f"={default!r}" if plain else "=…"


def markdown(text: str) -> str:
    """A docstring in numpydoc's form as Markdown."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")
    text = re.sub(r"`sgstore\.(?:\w+\.)*?([A-Z]\w*(?:\.\w+)?)`", r"`\1`", text)
    blocks = re.split(r"(?m)^(\w[\w ]*)\n-{3,}\n", text)
    lines = [prose(blocks[0])]
    for title, block in zip(blocks[1::2], blocks[2::2], strict=True):
        lines.append(f"**{title}**\n")
        written = {"Notes": prose, "Examples": console}.get(title, entries)
        lines.append(written(block))
    return "\n\n".join(line.strip("\n") for line in lines if line.strip())


def console(text: str) -> str:
    """Examples of a docstring, as a block."""
    return f"```pycon\n{text.strip()}\n```"


def prose(text: str) -> str:
    """Paragraphs; what follows ``::`` is a program."""

    def program(found: re.Match[str]) -> str:
        before = found[1].rstrip()
        opening = f"{before}:\n\n" if before else ""
        return f"{opening}```python\n{dedent(found[2]).strip()}\n```\n"

    text = re.sub(r"(?m)^(.*)::\n\n((?:(?: {4}.*)?\n)*(?: {4}.*)?)", program, text)
    return text.strip()


def entries(block: str) -> str:
    """Names with their types, and what stands below each, as a list."""
    told: list[str] = []
    for line in filter(str.strip, block.splitlines()):
        if line.startswith(" "):
            told[-1] += f" {line.strip()}"
        else:
            name, _, kind = line.strip().partition(" : ")
            names = ", ".join(f"`{one}`" for one in name.split(", "))
            told.append(f"* {names}" + f" ({kind})" * bool(kind) + ":")
    return "\n".join(one.removesuffix(":") for one in told)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    PAGE.with_name("relations.md").write_text(as_markdown(), encoding="utf-8")
