"""Parts of a selection that share no recording, such as train and test; and what one knows of another."""

from __future__ import annotations

import hashlib
import math
from typing import TYPE_CHECKING

import numpy as np

from sgstore.coverage import UNKNOWN, ReportTable, classed
from sgstore.errors import ConfigError
from sgstore.store import trace_of

if TYPE_CHECKING:
    from sgstore.selection._choose import Selection


def parse_split(text: str) -> dict[str, float]:
    """``train=0.8,test=0.2`` as shares by name.

    Raises
    ------
    ConfigError
        It is not that, or the shares are not 1 together.
    """
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        try:
            share = float(value)
        except ValueError:
            share = math.nan
        if not name.strip().isidentifier() or not 0 < share <= 1 or name.strip() in found:
            raise ConfigError(
                f"--split {text!r}: expected NAME=SHARE,…, such as train=0.8,test=0.2"
            )
        found[name.strip()] = share
    if not math.isclose(sum(found.values()), 1, abs_tol=1e-6):
        raise ConfigError(
            f"--split {text!r}: the shares are {sum(found.values()):g} together; expected 1"
        )
    return found


def split(selection: Selection, shares: dict[str, float]) -> dict[int, str]:
    """The part that each selected unit belongs to; all that comes from one recording belongs to one.

    The recordings with the most selected frames come first, each goes to the part that lacks most.

    Returns
    -------
    dict
        Number of unit → name of its part.
    """
    units = selection.units
    recording = {one.trace_id: one.digest for one in units.chosen.store.info()}
    of = [recording[trace] for trace in trace_of(units.first[selection.picked]).tolist()]
    rows = units.rows_of(selection.picked)
    traces, often = np.unique(trace_of(units.frame_id[rows]), return_counts=True)
    total: dict[str, int] = {}
    for trace, many in zip(traces.tolist(), often.tolist(), strict=True):
        total[recording[trace]] = total.get(recording[trace], 0) + many
    order = sorted(total, key=lambda d: (-total[d], _drawn(d, selection.spec.seed)))
    lack = {name: share * len(rows) for name, share in shares.items()}
    part: dict[str, str] = {}
    for digest in order:
        part[digest] = max(lack, key=lambda name: lack[name])
        lack[part[digest]] -= total[digest]
    return {unit: part[d] for unit, d in zip(selection.picked.tolist(), of, strict=True)}


def _drawn(digest: str, seed: int) -> bytes:
    return hashlib.blake2b(f"{seed} {digest}".encode(), digest_size=8).digest()


def split_table(
    selection: Selection, parts: dict[int, str], shares: dict[str, float]
) -> ReportTable:
    """Table of parts: their content, and the share of it that each other part has too.

    Returns
    -------
    ReportTable
        ``split``, ``units``, ``frames``, ``share`` (of the frames), ``wanted``, ``recordings``, ``classes``;
        and for each other part ``classes_in_…`` and ``frames_in_…``: the share of the classes, and of the
        frames, whose class occurs there, too. ``None``: of nothing.
    """
    units = selection.units
    of = classed(units.chosen, selection.spec.abstraction)
    code = np.full(len(units.frame_id), UNKNOWN)
    code[np.searchsorted(units.frame_id, of.frame_id)] = of.code
    mine = {
        name: np.array([unit for unit, part in parts.items() if part == name], np.int64)
        for name in shares
    }
    rows = {name: units.rows_of(own) for name, own in mine.items()}
    sizes = {
        name: np.bincount(code[own][code[own] != UNKNOWN], minlength=len(of.names))
        for name, own in rows.items()
    }
    digests = {one.trace_id: one.digest for one in units.chosen.store.info()}
    columns = ["split", "units", "frames", "share", "wanted", "recordings", "classes"]
    columns += [f"{what}_in_{name}" for name in shares for what in ("classes", "frames")]
    listed: list[tuple[object, ...]] = []
    total = max(sum(len(own) for own in rows.values()), 1)
    for name, wanted in shares.items():
        recordings = {digests[trace] for trace in trace_of(units.first[mine[name]]).tolist()}
        many = len(rows[name])
        has = sizes[name] > 0
        row: list[object] = [
            name,
            len(mine[name]),
            many,
            many / total,
            wanted,
            len(recordings),
            int(has.sum()),
        ]
        for other in shares:
            both = has & (sizes[other] > 0)
            same = name == other
            row.append(None if same or not has.any() else float(both.sum() / has.sum()))
            row.append(
                None
                if same or not has.any()
                else float(sizes[name][both].sum() / sizes[name].sum())
            )
        listed.append(tuple(row))
    said = ["by recording: no recording is in two parts"]
    if len(set(parts.values())) < len(shares):
        said.append("there are too few recordings: a part is empty")
    return ReportTable(tuple(columns), listed, said)
