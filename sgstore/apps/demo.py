"""Demonstration with a sample recording: ingest, find, show, export."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.base.display import number_of
from sgstore.draw import check_installed
from sgstore.errors import ExportError, MissingExtraError, TraceError
from sgstore.exporters import Export, WrittenClip, parse_mounts, write_export
from sgstore.ingest import ingest
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.matches import Interval

    Say = Callable[[str], object]


QUESTIONS: Final = (
    (
        "crossing-at-red",
        "Does a person cross in the lane of the ego, ahead of it, while the light is red?",
        """\
MATCH (e:Ego)-[:isIn]->(lane:Lane)<-[:isIn]-(p:Person),
      (light:TrafficLight {light_state: 'red'})-[:controlsTrafficOf]->(lane)
WHERE abs(bearing(e, p)) < 45""",
    ),
    (
        "cut-in",
        "Does a vehicle cut in from the next lane, closely ahead of the ego?",
        """\
MATCH (e:Ego)-[:isIn]->(lane:Lane)<-[:isIn]-(v:Vehicle)-[:isIn]->(beside:Lane),
      (beside)-[:laneChange]->(lane)
WHERE abs(bearing(e, v)) < 45 AND gap(e, v) < 12 AND v.speed > 1""",
    ),
    (
        "jaywalking",
        "Does a person walk on a driving lane, near the ego and off the crosswalks?",
        """\
MATCH (e:Ego), (p:Person)-[at:isIn]->(lane:Lane {lane_type: 'driving'})
WHERE dist(e, p) < 25 AND at.overlap > 0.5 AND NOT EXISTS {(p)-[:isIn]->(:Crosswalk)}""",
    ),
)
"""Queries of a test engineer: name of the result picture, sentence, pattern.

Each has a match in the sample; ``samples/town/README.md`` lists them."""

STORE: Final = "demo.sgstore"

_SAMPLE: Final = Path(__file__).parent / "sample"
RECORDING: Final = _SAMPLE / "town.mcap"
"""Complete sample recording, only in a source checkout. The wheel would become much larger with it."""
SMALL: Final = _SAMPLE / "small" / "town.mcap"
"""Small sample recording of the same drive: no lidar, a picture every two seconds. It is part of the wheel."""

MOUNTS: Final = ("ego/lidar=0,0,1.75", "ego/camera/front=0.45,0,1.42,-90,0,-90")
"""Poses of the sensors on the ego."""


def bundled() -> Path:
    """Return the path of the sample recording: the complete one in a source checkout, else the small one."""
    return RECORDING if RECORDING.is_file() else SMALL


def run_demo(folder: str | Path, say: Say, recording: str | Path | None = None) -> None:
    """Run the demonstration in a folder, and report each step.

    Parameters
    ----------
    folder : str or Path
        Created if missing; the results of an earlier run are replaced.
    say : function
        Function that prints a line.
    recording : str or Path, optional
        The sample recording; by default the one of the package.

    Raises
    ------
    ExportError
        The folder has other content.
    SgstoreError
        Any error of the library.
    """
    folder, recording = Path(folder), Path(recording or bundled())
    if not recording.is_file():
        raise TraceError(
            "file not found; leave out --recording to use the packaged recording", path=recording
        )
    _prepare(folder)
    _ingest(folder / STORE, recording, say)
    store = Store(folder / STORE)
    pictures = [_answer(store, folder, say, *question) for question in QUESTIONS]
    clips = _export(store, folder, say)
    _say_what_next(folder, clips, pictures, say)


def _prepare(folder: Path) -> None:
    store = folder / STORE
    if folder.exists() and not store.exists() and any(folder.iterdir()):
        raise ExportError(
            f"{folder} holds something else; name a folder that is empty or not there"
        )
    folder.mkdir(parents=True, exist_ok=True)
    store.unlink(missing_ok=True)
    shutil.rmtree(folder / "clips", ignore_errors=True)


def _ingest(store: Path, sample: Path, say: Say) -> None:
    say("A drive of 75 s through a small town, as a simulator recorded it: ground truth at 10 Hz,")
    say(f"sensors, and the road map, in {sample.stat().st_size / 1e6:.1f} MB of MCAP.")
    say("")
    say(f"$ sgstore ingest {store} town.mcap")
    outcome = ingest(store, [sample])[0]
    if outcome.error:
        raise outcome.error
    kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(outcome.entities.items()))
    say(f"  {outcome.frames} scene graphs in {outcome.seconds:.1f} s, of {kinds}.")


def _answer(
    store: Store, folder: Path, say: Say, name: str, sentence: str, pattern: str
) -> Path | None:
    """Run a query, and report the intervals of its matches. Draw the middle frame of the first interval."""
    say("")
    say(sentence)
    say("")
    for line in pattern.splitlines():
        say(f"    {line}")
    say("")
    matches = store.find(pattern)
    found = list(matches.intervals())
    say(f"  {number_of(matches.count(), 'frame')}:")
    for interval in found:
        who = ", ".join(_bound(interval))
        say(f"  {interval.start:6.1f} s to {interval.end:4.1f} s   {who}")
    picture = folder / f"{name}.png"
    middle = (found[0].start_seq + found[0].end_seq) // 2
    try:
        check_installed()
        from sgstore.draw import draw_stored  # a late import, because it loads the drawing packages

        draw_stored(store, f"{found[0].trace}#{middle}", picture, matches=matches)
    except MissingExtraError as error:
        say(f"  (no picture: {error})")
        return None
    say(f"  seen from above, and by the ego's camera: {picture}")
    return picture


def _bound(interval: Interval) -> list[str]:
    """Return a text such as ``p = person 15`` for each variable of a match."""
    return [
        f"{name.removesuffix('.name')} = {value}"
        for name, value in interval.values.items()
        if name.endswith(".name")
    ]


def _export(store: Store, folder: Path, say: Say) -> Path:
    _, _, pattern = QUESTIONS[0]
    to = folder / "clips"
    clips = list(store.find(pattern).clips(before=2.0, after=2.0))
    export = Export(
        store,
        tuple(clips),
        with_graph=True,
        mounts=parse_mounts(MOUNTS),
        rebase_context=True,
        provenance={"query": pattern},
    )
    written = [one for one in write_export(export, to) if isinstance(one, WrittenClip)]
    say("")
    say(
        "The first answer as a test case of its own: the original messages, 2 s before to 2 s after."
    )
    say("")
    for clip in written:
        seconds = (clip.end_ns - clip.start_ns) / 1e9
        messages = sum(channel.messages for channel in clip.messages)
        say(
            f"  {clip.file}: {seconds:.1f} s, {number_of(messages, 'message')}, those of sensors among them"
        )
    return written[0].file


def _say_what_next(folder: Path, clip: Path, pictures: list[Path | None], say: Say) -> None:
    store = folder / STORE
    say("")
    say("Next commands:")
    say("")
    called = Path(sys.argv[0])
    if called.name == "sgstore" and not shutil.which("sgstore"):
        say(f"  . {called.parent / 'activate'}")
    pattern = '"MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN v.name, INTERVALS"'
    count = '"FROM edges SELECT relation, dst_kind, count(*) GROUP BY ALL"'
    say(f"  sgstore find {store} {pattern}")
    say(f"  sgstore sql {store} {count}")
    say(f"  sgstore show {store} town@38s -o turning.svg")
    say(f"  sgstore ingest {store} YOUR.mcap")
    say("")
    if any(pictures):
        say(f"The pictures are in {folder}/.")
    say(f"{clip} opens in Foxglove or Lichtblick, and in sgstore again;")
    say(f"{clip.with_name('layout.json')} is a layout for both.")
