"""What the frames of a trace themselves tell of the recording: who is in it, and how its clock runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

SHOWN: Final = 20
"""Jumps and gaps that are listed; the others are counted."""

GAP: Final = 2.5
"""How many median periods are a gap. The same ends an interval of frames (:mod:`sgstore.lang.results`)."""

_KINDS: Final = "SELECT kind::VARCHAR, count(*) FROM entity GROUP BY kind ORDER BY kind"

_STEPS: Final = """
WITH step AS (
  SELECT frame_id, seq, time_ns - lag(time_ns) OVER (ORDER BY frame_id) AS step,
         (time_ns - first(time_ns) OVER (ORDER BY frame_id)) / 1e9 AS t
  FROM frame),
usual AS (SELECT quantile_disc(step, 0.5) AS period FROM step WHERE step > 0)
SELECT seq, t, step / 1e9, step < 0 FROM step CROSS JOIN usual
WHERE step < 0 OR (step > $gap * period) ORDER BY frame_id
"""


def report_of(connection: DuckDBPyConnection) -> dict[str, Any]:
    """A report on the frames and entities in the tables of a segment, as plain values.

    Returns
    -------
    dict
        ``entities``: kind → how many there are; ``clock_jumps``, ``gaps``: how often the clock of the recording
        runs backwards, or further than 2.5 periods; ``clock_jumps_at``, ``gaps_at``: the first of them, each
        with the frame behind (``seq``), its time since the trace began (``t``), and the step (``seconds``).
    """
    steps = connection.execute(_STEPS, {"gap": GAP}).fetchall()
    report: dict[str, Any] = {"entities": dict(connection.execute(_KINDS).fetchall())}
    for name, back in (("clock_jumps", True), ("gaps", False)):
        found = [
            {"seq": seq, "t": t, "seconds": step} for seq, t, step, jump in steps if jump == back
        ]
        report |= {name: len(found), f"{name}_at": found[:SHOWN]}
    return report
