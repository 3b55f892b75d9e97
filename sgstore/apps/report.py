"""Report: the matches of a query as one HTML file that works without a server and without a network.

The file contains the page's modules as one script, and the data that they would request from a
server: matches, truth lanes, states around each match, outlines of maps and optionally camera
pictures. A policy in the file permits only that script, and no requests.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import re
from dataclasses import astuple, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.apps.explorer import PAGE, Reads, answer, as_json, packed
from sgstore.base.output_files import write_bytes
from sgstore.errors import SgstoreError
from sgstore.model.user_notes import NotesFile
from sgstore.store import StateColumns

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.query import Store

CHUNK: Final = 300
"""Number of frames in each request of the page for states (``CHUNK`` in ``data.js``)."""

MOST_LOOKED_AT: Final = 20_000
"""Largest number of matches from which the matches of a report are selected."""

POLICY: Final = (
    "default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}';"
    " base-uri 'none'; form-action 'none'; require-trusted-types-for 'script'"
)

Found = tuple[str, int, int, dict[str, int]]
"""Match: trace, first and last frame, and nodes by variable."""
Spans = dict[str, list[tuple[int, int]]]
"""Trace → ranges of stored frames (first and last), in order and without overlaps."""


def report(
    store: Store,
    text: str,
    to: Path,
    *,
    parameters: Mapping[str, Any] | None = None,
    most: int = 100,
    around_s: float = 2.0,
    pictures: bool = False,
) -> tuple[int, bool]:
    """Write the matches of a query as one HTML page that works without a server.

    Parameters
    ----------
    store : Store
    text : str
        A pattern; or checks, whose violations are shown.
    to : Path
        The output file.
    parameters : mapping, optional
        Values of ``$name``.
    most : int
        Greatest number of matches: as many of each trace, over its whole time. If the query orders its
        matches: the first ones.
    around_s : float
        Additional time before and after each match; s.
    pictures : bool
        True to include a picture of the first camera for each second of a match.

    Returns
    -------
    matches : int
        Number of included matches.
    truncated : bool
        True if there are more.

    Raises
    ------
    QueryError
        The text is not a query.
    """
    title = Path(to).stem
    page, many, truncated = _made(store, text, parameters, title, most, around_s, pictures)
    write_bytes(to, page.encode())
    return many, truncated


@dataclass(frozen=True)
class PlayableMatches:
    """Matches of a query. A notebook displays them as an interactive page, in an isolated HTML frame.

    Attributes
    ----------
    page : str
        The report, as written by :func:`report`.
    height : int
        Height of the frame; points.
    """

    page: str = field(repr=False)
    height: int

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self.height}px;border:1px solid #8886;border-radius:8px"
        page = html.escape(self.page, quote=True)
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{page}"></iframe>'


def inline(
    store: Store,
    text: str,
    *,
    parameters: Mapping[str, Any] | None = None,
    height: int = 620,
    most: int = 20,
    around_s: float = 2.0,
    pictures: bool = False,
) -> PlayableMatches:
    """Return the matches of a query as an object that a notebook displays as an interactive page.

    Parameters
    ----------
    store, text, parameters, most, around_s, pictures
        As in :func:`report`.
    height : int
        Height of the frame; points.

    Raises
    ------
    QueryError
        The text is not a query.
    """
    page, _, _ = _made(store, text, parameters, "sgstore", most, around_s, pictures)
    return PlayableMatches(page, height)


def _made(
    store: Store,
    text: str,
    parameters: Mapping[str, Any] | None,
    title: str,
    most: int,
    around_s: float,
    pictures: bool,  # noqa: FBT001 - as report has it
) -> tuple[str, int, bool]:
    """Return an HTML page of matches, their number, and True if the query has more matches."""
    with store.file.snapshot():
        kept, found, truncated = _kept(store, text, dict(parameters or {}), most, around_s)
        if pictures:
            kept["pictures"] = _pictures(store, kept["about"]["traces"], found)
    return _page(kept, title), len(found), truncated


def _kept(
    store: Store, text: str, values: dict[str, Any], most: int, around_s: float
) -> tuple[dict[str, Any], list[Found], bool]:
    """Return the data of a report page for JSON, its matches, and True if the query has more matches."""
    is_check = re.match(r"\s*(?:--[^\n]*\n\s*)*(?:DEFINE\b[^;]*;\s*)*CHECK\b", text, re.IGNORECASE)
    question = {"text": text, "parameters": values}
    asked = {"ask": "check" if is_check else "matches", "absent": True, **question}
    told = _spread(list(answer(store, asked, max(most, MOST_LOOKED_AT))), most)
    check, found = None, list[Found]()
    if is_check:
        (check,) = told
        spans = [(one["trace"], *span) for one in check["verdicts"] for span in one["spans"]]
        found = [(trace, first, last, {}) for trace, first, last, *_ in spans]
    else:
        found = list(_found(told))
    reads = Reads(store)
    about = reads.about()
    traces = {one["name"]: one for one in about["traces"] if one["name"] in {m[0] for m in found}}
    for one in traces.values():
        one |= {"cameras": []}
    times = {name: _times(store, name, about["frames"]) for name, about in traces.items()}
    spans = _spans(found, times, around_s)
    kept: dict[str, Any] = {
        "about": {**about, "traces": [*traces.values()], "around": around_s},
        "query": text,
        "parameters": values,
        "made": datetime.now(UTC).isoformat(" ", "minutes")[:16] + " UTC",
        "find": told,
        "check": check,
        "parts": {} if is_check else _parts(store, question, found),
        "notes": [astuple(note) for note in _notes(store)],
        "columns": dict(_columns(store, reads, traces, spans)),
        "pictures": {},
    }
    return kept, found, bool(told[-1].get("truncated"))


def _spread(told: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Keep at most ``most`` matches or violations in the replies to a query; return the replies.

    They are spread over the traces, or the first ones in the order of the query.
    """
    lists = [(reply, "matches", "") for reply in told if "matches" in reply]
    lists += [(one, "spans", one["trace"]) for one in told[-1].get("verdicts", ())]
    traces = [str(trace or row[0]) for part, key, trace in lists for row in part[key]]
    if len(traces) <= most:
        return told
    chosen = told[0].get("lists") == "chosen"
    kept = set(range(most)) if chosen else chosen_spread(traces, most)
    number = 0
    for part, key, _ in lists:
        end = number + len(part[key])
        part[key] = [row for at, row in enumerate(part[key], number) if at in kept]
        number = end
    told[-1] |= {"count": most, "truncated": True}
    return told


def chosen_spread(traces: list[str], most: int) -> set[int]:
    """Choose ``most`` items, spread over the traces and evenly within each trace. Return their indices.

    Parameters
    ----------
    traces : list of str
        Trace of each item.
    most : int
        Greatest number of items.

    Examples
    --------
    >>> sorted(chosen_spread(["a"] * 5 + ["b"], 3))
    [0, 4, 5]
    """
    places: dict[str, list[int]] = {}
    for at, trace in enumerate(traces):
        places.setdefault(trace, []).append(at)
    share, left, many = dict.fromkeys(places, 0), min(most, len(traces)), len(places)
    for trace, mine in sorted(places.items(), key=lambda item: len(item[1])):  # few leave more
        share[trace] = min(len(mine), left // many)
        left, many = left - share[trace], many - 1
    even = (np.linspace(0, len(mine) - 1, share[trace]).round() for trace, mine in places.items())
    of = zip(places.values(), even, strict=True)
    return {mine[int(at)] for mine, some in of for at in some}


def _found(told: list[dict[str, Any]]) -> Iterator[Found]:
    """Yield matches (trace, first frame, last frame, binding) from the replies to a query."""
    names: tuple[str, ...] = ()
    for reply in told:
        names = reply.get("names", names)
        for trace, first, last, _, _, *values in reply.get("matches", ()):
            pairs = zip(names, values, strict=True)
            yield (
                trace,
                first,
                last,
                {n: v for n, v in pairs if f"{n}.name" in names and v is not None},
            )


def _notes(store: Store) -> list[Any]:
    try:
        return NotesFile(store.file.path).read()
    except SgstoreError:
        return []


def _key(*values: Any) -> str:
    return json.dumps(values, separators=(",", ":"), ensure_ascii=False)


def _times(store: Store, trace: str, frames: int) -> NDArray[np.float64]:
    """Return the times of all frames of a trace since its start; s."""
    return StateColumns(store.file).frames(trace, 0, frames - 1)["t"]


def _spans(found: list[Found], times: Mapping[str, NDArray[np.float64]], around_s: float) -> Spans:
    """For each trace, return the ranges of frames to show: its matches, and some seconds around each."""
    spans: Spans = {}
    for trace, first, last, _ in sorted(found, key=lambda match: match[:3]):
        t, around = times[trace], around_s + 1e-6  # times have six decimals
        low = int(np.searchsorted(t, t[first] - around))
        high = int(np.searchsorted(t, t[last] + around)) - 1
        mine = spans.setdefault(trace, [])
        if mine and low <= mine[-1][1] + 1:
            mine[-1] = mine[-1][0], max(mine[-1][1], high)
        else:
            mine.append((low, high))
    return spans


def _parts(store: Store, question: Mapping[str, Any], found: list[Found]) -> dict[str, Any]:
    """For each match, return the frames in which each part of the pattern is true."""
    first = {
        _key(trace, nodes or None): (trace, seq, nodes) for trace, seq, _, nodes in found[::-1]
    }
    matches = store.find(question["text"], **question["parameters"])
    bound = {key: one for key, one in first.items() if one[2]}
    lanes = dict(zip(bound, matches.parts_each([*bound.values()]), strict=True))
    for key in first.keys() - bound.keys():  # the pattern has no nodes
        trace, seq, _ = first[key]
        lanes[key] = store.parts(question["text"], f"{trace}#{seq}", **question["parameters"])
    keys = dict.fromkeys(_key(trace, nodes or None) for trace, _, _, nodes in found)
    return {key: lanes[key].as_dict() for key in keys}


def _columns(
    store: Store, reads: Reads, traces: Mapping[str, Any], spans: Spans
) -> Iterator[tuple[str, str]]:
    """Yield the binary data of a report page (static entities, maps, states), each with its request key."""
    maps: set[str] = set()
    for name, about in traces.items():
        yield _key("api/static", name), _small(reads.static(name))
        if about["map_key"] and about["map_key"] not in maps:
            maps.add(about["map_key"])
            yield _key("api/map", about["map_key"]), _small(reads.map(name))
        numbers = sorted({k for a, z in spans[name] for k in range(a // CHUNK, z // CHUNK + 1)})
        for number in numbers:
            first = number * CHUNK
            last = min(first + CHUNK, about["frames"]) - 1
            data = _states(store, name, first, last, spans[name])
            yield _key("api/states", name, first, last), _small(data)


def _states(store: Store, trace: str, first: int, last: int, spans: list[tuple[int, int]]) -> bytes:
    """Return the entity states of a trace as bytes. Frames outside the given ranges have no states."""
    of = StateColumns(store.file)
    with store.file.snapshot():
        frames, states = of.frames(trace, first, last), of.states(trace, first, last)
    seq = states.pop("seq")
    inside = np.zeros(len(seq), bool)
    for low, high in spans:
        inside |= (low <= seq) & (seq <= high)
    start = np.searchsorted(seq[inside], np.append(frames["seq"], last + 1)).astype(np.uint32)
    columns = {f"frame.{name}": frames[name] for name in ("seq", "ego")} | {"frame.start": start}
    kept = {name: column[inside] for name, column in states.items()}
    return packed({"trace": trace, "first": first, "last": last}, columns | kept)


def _small(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()


def _pictures(
    store: Store, traces: list[dict[str, Any]], matches: list[Found]
) -> dict[str, dict[str, str]]:
    """Return pictures of the first camera of each trace: one picture for each second of each match."""
    reads, found = Reads(store), dict[str, dict[str, str]]()
    cameras = {one["name"]: one["cameras"] for one in reads.about()["traces"]}
    for about in traces:
        trace, topics = about["name"], cameras[about["name"]][:1]
        about["cameras"] = topics
        times = _times(store, trace, about["frames"])
        wanted = set[int]()
        for _, first, last, _ in (match for match in matches if match[0] == trace):
            second = np.floor(times[first : last + 1] - times[first] + 1e-6)
            wanted.update((first + np.unique(second, return_index=True)[1]).tolist())
        for topic in topics:
            kept = found[_key(trace, topic)] = {}
            for seq in sorted(wanted):
                try:
                    data, _ = reads.picture(trace, seq, topic)
                except SgstoreError:
                    continue  # some frames have none
                kept[str(seq)] = base64.b64encode(data).decode()
    return found


_IMPORT: Final = re.compile(
    r"""^import (?:\* as (?P<whole>\w+)|\{(?P<names>[^}]*)\}) from "(?P<file>[^"]+)";$""",
    re.MULTILINE,
)
_EXPORT: Final = re.compile(
    r"^export (?P<kind>const|class|function\*?|async function\*?) (?P<name>\w+)", re.MULTILINE
)
_MINIFIED: Final = re.compile(r"export\{([^}]*)\};?\s*$")


def script() -> str:
    """Combine the JavaScript modules of a report page into one script, and return its text."""
    parts: list[str] = []
    names: dict[Path, str] = {}

    def add(file: Path) -> str:
        if file.name == "api.js":
            file = file.with_name("offline.js")
        if file not in names:
            text = file.read_text(encoding="utf-8")
            text = _IMPORT.sub(
                lambda found: _imported(found, add((file.parent / found["file"]).resolve())), text
            )
            names[file] = f"of_{file.stem}"
            parts.append(f"const {names[file]} = (() => {{\n{_exported(text)}\n}})();\n")
        return names[file]

    add((PAGE / "js" / "report.js").resolve())
    return "".join(parts)


def _imported(found: re.Match[str], name: str) -> str:
    if found["whole"]:
        return f"const {found['whole']} = {name};"
    return f"const {{{' '.join(found['names'].split())}}} = {name};"


def _exported(text: str) -> str:
    """Convert a JavaScript module to the body of a function that returns the exports of the module."""
    minified = _MINIFIED.search(text)
    if minified:
        pairs = (one.split(" as ") for one in minified[1].split(","))
        told = ", ".join(f"{pair[-1]}: {pair[0]}" for pair in pairs)
        return f"{text[: minified.start()]}return {{ {told} }};"
    exported = [found["name"] for found in _EXPORT.finditer(text)]
    body = _EXPORT.sub(lambda found: f"{found['kind']} {found['name']}", text)
    return f"{body}\nreturn {{ {', '.join(exported)} }};"


def _page(kept: dict[str, Any], title: str) -> str:
    code, style = script(), (PAGE / "style.css").read_text(encoding="utf-8")
    digests = {
        name: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        for name, text in (("script", code), ("style", style))
    }
    told = {
        "policy": POLICY.format(**digests),
        "title": html.escape(title),
        "style": style,
        "kept": as_json(kept).decode().replace("<", "\\u003c"),
        "script": code,
    }
    text = (PAGE / "report.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda place: told[place[1]], text)
