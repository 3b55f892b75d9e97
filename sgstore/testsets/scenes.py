"""Short texts that describe scenes, such as ``ego, 2 cars near, 1 lane``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.collection import Collection
    from sgstore.testsets.coverage import ReportTable

MOST: Final = 200
"""Largest number of table rows that get a description of the scene."""

_SCENES: Final = """
SELECT w.place, e.dst_kind::VARCHAR AS kind, e.relation = 'isIn' AS inside, count(DISTINCT e.dst) AS number
FROM (SELECT unnest($place::BIGINT[]) AS place, unnest($trace::VARCHAR[]) AS trace,
             unnest($seq::BIGINT[]) AS seq) w
     JOIN frames f USING (trace, seq) LEFT JOIN edges e
     ON e.frame_id = f.frame_id AND e.src_is_ego AND e.src = f.ego
        AND (e.relation IN ('near_coll', 'super_near', 'very_near', 'near')
             AND e.dst_kind NOT IN ('prop', 'building', 'pole', 'barrier', 'vegetation')
             OR e.relation = 'isIn')
WHERE f.ego IS NOT NULL GROUP BY ALL ORDER BY inside, number DESC, kind
"""


def phrases(store: Store, frames: Sequence[str]) -> list[str]:
    """For each frame, return a short text: the entities near the ego, and the map parts below the ego.

    Parameters
    ----------
    store : Store
    frames : sequence of str
        Names of frames, such as ``town#120``.
    """
    parts = [name.rpartition("#") for name in frames]
    values = {"place": [*range(len(frames))], "trace": [one[0] for one in parts]}
    values["seq"] = [one[2] for one in parts]
    found: dict[int, list[str]] = {}
    for place, kind, inside, number in store.file.rows(_SCENES, values):
        phrase = found.setdefault(place, ["ego"])
        if kind is None:
            continue
        plural = "es" if kind.endswith("s") else "s"
        noun = kind.replace("_", " ") + (plural if number > 1 else "")
        phrase.append(f"{number} {noun}{'' if inside else ' near'}")
    return [", ".join(found.get(place, ["no ego"])) for place in range(len(frames))]


def with_scenes(
    table: ReportTable, store: Store | Collection, vanished_from: Store | Collection | None = None
) -> ReportTable:
    """Return a table with a column ``scene``, which describes the frame of each row in words.

    Parameters
    ----------
    table : ReportTable
        A table with a column ``frame``; others are returned unchanged.
    store : Store or Collection
        Store of the frames. A collection has no phrases.
    vanished_from : Store or Collection, optional
        Store of the frames of rows with the change ``vanished``.
    """
    stores = [store] if vanished_from is None else [store, vanished_from]
    if "frame" not in table.columns or not all(isinstance(one, Store) for one in stores):
        return table
    frames = table.column("frame")[:MOST]
    gone = [bool(vanished_from) and row[0] == "vanished" for row in table.rows[:MOST]]
    told = dict[int, str]()
    for number, one in enumerate(stores):
        places = [i for i, which in enumerate(gone) if which == bool(number)]
        if isinstance(one, Store) and places:
            told |= zip(places, phrases(one, [frames[i] for i in places]), strict=True)
    rows = [(*row, told.get(i, "")) for i, row in enumerate(table.rows)]
    return replace(table, columns=(*table.columns, "scene"), rows=rows)
