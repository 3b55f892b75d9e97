"""First look at recordings: contents, rare and critical scenes, violated rules, and missing data.

A bounded sample of the recordings is read into a store. All patterns and rules of the library are evaluated on
it. The result is one page, as text or as HTML.
"""

from __future__ import annotations

import base64
import html
import shlex
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.display import first_of, html_table, text_table
from sgstore.errors import SgstoreError
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.query import Store
from sgstore.testsets.coverage import ChosenFrames
from sgstore.testsets.selection import MEASURES, Priority, PrioritySpec, SelectionUnit, prioritize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from sgstore.ingest import Progress
    from sgstore.matches import Interval
    from sgstore.pipeline.recording_ingest import TraceOutcome

    Each = Callable[[Sequence[Any], str], Iterable[Any]]

MOST_RECORDINGS: Final = 100
"""Largest number of recordings in the sample. They are spread over all recordings."""

SECONDS: Final = 1200.0
"""Length of the sample; s. The first seconds of each recording are read."""

ENTRIES: Final = 10
"""Largest number of entries in a section of the page."""

CLIP_S: Final = 2.0
"""Length of a critical scene; s."""

STORE: Final = "drives.sgstore"
"""Name of the store in the command lines that reproduce an entry."""


@dataclass(frozen=True)
class FirstLookEntry:
    """Entry of a first-look report, with command lines and code that reproduce it.

    Attributes
    ----------
    title, text : str
    frame : str
        A frame of the scene, ``trace#seq``; empty without a frame.
    lines : dict of str to str
        Line that reproduces the finding: ``CLI``, ``SQL``, ``Python`` and ``CI``.
    """

    title: str
    text: str
    frame: str
    lines: dict[str, str]


@dataclass
class FirstLook:
    """Report on a sample of recordings: contents, rare and critical scenes, violated rules, missing data.

    Attributes
    ----------
    store : Store
        Store of the sample.
    outcomes : list of TraceOutcome
        Recordings of the sample.
    skipped : int
        Number of recordings that are not in the sample.
    sections : dict of str to list of FirstLookEntry
        Findings by the heading of their section.
    unanswered : dict of str to list of str
        Reason → patterns and rules without an answer in any trace.
    missing : Counter
        Missing or lost data → number of recordings.
    """

    store: Store
    outcomes: list[TraceOutcome]
    skipped: int
    sections: dict[str, list[FirstLookEntry]] = field(
        default_factory=dict[str, list[FirstLookEntry]]
    )
    unanswered: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    missing: Counter[str] = field(default_factory=Counter[str])

    def contents(self) -> list[tuple[Any, ...]]:
        """Return a row for each recording: trace, file, frames, entities, and its error or losses."""
        return [
            (
                one.name,
                one.path.name,
                one.frames,
                ", ".join(f"{many} {kind}" for kind, many in sorted(one.entities.items())),
                str(one.error or "") or (f"losses: {len(one.losses)}" if one.losses else ""),
            )
            for one in self.outcomes
        ]

    def text(self) -> str:
        """Return the report as text."""
        parts = [self._head(), text_table(_CONTENTS, self.contents()), _STEPS]
        for heading, entries in self.sections.items():
            parts.append(f"{heading}\n" + ("" if entries else "  none"))
            for one in entries:
                lines = [f"  {one.title}: {one.text}", f"    {one.lines['CLI']}"]
                parts[-1] += "\n".join(lines) + "\n"
        for heading, rows in self._lists():
            parts.append("\n".join([heading, *(f"  {row}" for row in rows or ["none"])]))
        return "\n\n".join(part.rstrip() for part in parts)

    def html(self) -> str:
        """Return the report as HTML, with pictures if the packages for drawing are installed."""
        parts = [f"<p>{html.escape(self._head())}</p>", html_table(_CONTENTS, self.contents())]
        parts.append(f"<pre>{html.escape(_STEPS)}</pre>")
        for heading, entries in self.sections.items():
            parts.append(f"<h2>{html.escape(heading)}</h2>")
            parts.append("".join(map(self._card, entries)) or "<p>none</p>")
        for heading, rows in self._lists():
            items = "".join(f"<li>{html.escape(row)}</li>" for row in rows or ["none"])
            parts.append(f"<h2>{html.escape(heading)}</h2><ul>{items}</ul>")
        return _PAGE.format(body="\n".join(parts))

    def _head(self) -> str:
        frames = sum(one.frames for one in self.outcomes)
        skipped = f"; recordings outside of the sample: {self.skipped}" if self.skipped else ""
        return f"recordings: {len(self.outcomes)}, frames in the sample: {frames:,}{skipped}"

    def _lists(self) -> Iterator[tuple[str, list[str]]]:
        unanswered = self.unanswered.items()
        yield "Questions without an answer", [f"{why}: {first_of(of, 8)}" for why, of in unanswered]
        missing = self.missing.most_common(2 * ENTRIES)
        yield "Missing data", [f"{what} (recordings: {many})" for what, many in missing]

    def _card(self, one: FirstLookEntry) -> str:
        lines = "".join(
            f"<dt>{face}</dt><dd><code>{html.escape(line)}</code></dd>"
            for face, line in one.lines.items()
        )
        title, text = html.escape(one.title), html.escape(one.text)
        picture = self._picture(one.frame) if one.frame else ""
        return f"<article>{picture}<h3>{title}</h3><p>{text}</p><dl>{lines}</dl></article>"

    def _picture(self, frame: str) -> str:
        from sgstore.draw import thumbnail

        try:
            data = thumbnail(self.store.file, self.store.frame(frame).ref)
        except SgstoreError:  # drawing packages or the recording are missing
            return ""
        return f'<img alt="{html.escape(frame)}" src="data:image/jpeg;base64,{_base64(data)}">'


def sampled(
    recordings: Sequence[Path],
    store: Path,
    on_progress: Callable[[Progress], None] | None = None,
) -> FirstLook:
    """Read a sample of recordings into a store, and return a report about its contents.

    Parameters
    ----------
    recordings : sequence of Path
        Recordings, as found by :func:`sgstore.ingest.recordings`.
    store : Path
        New store for the sample.
    on_progress : function, optional
        Called after every block of frames.

    Raises
    ------
    StoreError
        The store cannot be written.
    TraceError
        No recording is readable.
    """
    every = -(-len(recordings) // MOST_RECORDINGS)
    sample = recordings[::every]
    until = max(SECONDS / max(len(sample), 1), CLIP_S)
    outcomes = ingest(store, sample, until=until, on_progress=on_progress)
    if not store.exists():
        raise next(one.error for one in outcomes if one.error is not None)
    missing = Counter(kind for one in outcomes for kind in {*map(_kind_of, _oddities(one))})
    return FirstLook(Store(store), outcomes, len(recordings) - len(sample), missing=missing)


def evaluate(look: FirstLook, each: Each = lambda items, _: items) -> None:
    """Evaluate the patterns and rules of the library on the sample, and add the results to the report.

    Parameters
    ----------
    look : FirstLook
    each : function, optional
        Wraps the patterns to evaluate, to show progress: items and their noun → items.
    """
    with look.store.file.shared():
        rare, rules = _rare(look, each), _rules(look, each)
        look.sections = {
            "Rarest scenes of the library": rare,
            "Most critical scenes": _critical(look.store),
            "Violated rules": rules,
        }


def _rare(look: FirstLook, each: Each) -> list[FirstLookEntry]:
    """Return the rarest patterns of the library in the sample. Note patterns that cannot be answered."""
    found: list[tuple[int, str, str, Interval]] = []
    asked = [one for one in patterns().values() if one.kind in {"concept", "scenario"}]
    traces = len(look.store.traces())
    for one in each(asked, "patterns"):
        matches = look.store.find(one.text)
        if len(matches.left_out) == traces:
            reason = next(iter(matches.reasons.values()))
            look.unanswered.setdefault(reason, []).append(one.name)
            continue
        spans = [*matches.intervals()]
        if spans:
            found.append((len(spans), one.name, one.sentence, spans[0]))
    return [
        FirstLookEntry(
            name,
            f"{sentence} Matches: {many}; the first in {span.trace} at {span.start:.1f} s.",
            f"{span.trace}#{span.start_seq}",
            {
                "CLI": f"sgstore find {STORE} {name}",
                "SQL": f"SELECT * FROM sgql('{name}')",  # noqa: S608  a line to copy
                "Python": f'store.find("{name}").df()',
                "CI": f"sgstore find {STORE} {name} --require",
            },
        )
        for many, name, sentence, span in sorted(found, key=lambda row: row[:2])[:ENTRIES]
    ]


def _critical(store: Store) -> list[FirstLookEntry]:
    """Return the most critical scenes of the sample: the clips with the highest risk."""
    spec = PrioritySpec(Priority.risk, tuple(MEASURES), SelectionUnit.clip, CLIP_S)
    ordered = prioritize(ChosenFrames(STORE, store), spec)
    entries: list[FirstLookEntry] = []
    for place, unit, *_, reason in ordered.rows():
        if place > ENTRIES:
            break
        frame = str(unit).rpartition("-")[0]  # of town#380-399
        entries.append(
            FirstLookEntry(
                f"{place}. {unit}",
                str(reason),
                frame,
                {
                    "CLI": shlex.join(["sgstore", "show", STORE, frame]),
                    "SQL": _sql_of(store, frame),
                    "Python": f"store.show({frame!r})",
                    "CI": f"sgstore prioritize {STORE} --unit clip --limit {ENTRIES} -o critical.lock",
                },
            )
        )
    return entries


def _rules(look: FirstLook, each: Each) -> list[FirstLookEntry]:
    """Return the violated rules of the library. Note the rules that cannot be answered."""
    entries: list[tuple[int, FirstLookEntry]] = []
    for one in each([one for one in patterns().values() if one.is_check], "rules"):
        verdicts = [*look.store.check(one.text)]
        violated = [verdict for verdict in verdicts if verdict.verdict == "false"]
        if verdicts and all(verdict.verdict == "unknown" for verdict in verdicts):
            look.unanswered.setdefault(verdicts[0].reason, []).append(one.name)
        if not violated:
            continue
        # HAVING can leave a violated trace without listed violations
        span = next((span for verdict in violated for span in verdict.violations), None)
        trace = violated[0].trace if span is None else span.trace
        frame = "" if span is None else f"{span.trace}#{span.start_seq}"
        place = f" at {span.start:.1f} s" if span else ""
        text = (
            f"Violated in {len(violated)} of {len(verdicts)} traces, the first in {trace}{place}."
        )
        lines = {
            "CLI": f"sgstore check {STORE} {one.name}",
            "SQL": _sql_of(look.store, frame or f"{trace}#0"),
            "Python": f'for verdict in store.check("{one.name}"): print(verdict)',
            "CI": f"sgstore check {STORE} {one.name} --require --junit rules.xml",
        }
        found = FirstLookEntry(one.name, f"{one.sentence} {text}", frame, lines)
        entries.append((-len(violated), found))
    return [entry for _, entry in sorted(entries, key=lambda row: (row[0], row[1].title))]


def _sql_of(store: Store, frame: str) -> str:
    return f"SELECT * FROM nodes WHERE frame_id = {store.frame(frame).ref.frame_id}"  # noqa: S608  a line to copy


def _oddities(outcome: TraceOutcome) -> Iterator[str]:
    """Yield the warnings, the losses and the error of a recording."""
    yield from outcome.warnings
    yield from (loss.reason for loss in outcome.losses)
    if outcome.error is not None:
        yield str(outcome.error)


def _kind_of(text: str) -> str:
    """Replace the numbers in a warning, so that similar warnings can be counted together."""
    return " ".join("N" if any(c.isdigit() for c in word) else word for word in text.split())


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


_CONTENTS: Final = ("trace", "file", "frames", "entities", "problems")

_STEPS: Final = f"""\
The lines below read all recordings first:
  sgstore ingest {STORE} FOLDER
  store = sgstore.open("{STORE}")"""

_PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>sgstore: first look</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem;
  color: light-dark(#1c1c1c, #e6e6e6); background: light-dark(#fff, #161616); color-scheme: light dark; }}
table {{ border-collapse: collapse; display: block; overflow-x: auto; }}
article {{ border-top: 1px solid #8884; padding: 1rem 0; overflow: auto; }}
article img {{ float: right; max-width: 40%; margin-left: 1rem; border-radius: 6px; }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: 0 1rem; }} dd {{ margin: 0; }}
code, pre {{ font: 13px/1.6 ui-monospace, monospace; overflow-wrap: anywhere; }}
</style></head><body><h1>First look</h1>
{body}
</body></html>
"""
