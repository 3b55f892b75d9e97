"""Selection from a collection: each bundle returns only the units that a minimal selection may need.

Of units with the same classes the cheapest is enough. Therefore a bundle reports one unit for each
set of classes, with its frames, and its numbers of units and frames. The selection and its bounds
are equal to those of all units.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.base.temporary_folders import working_folder
from sgstore.store import PartFile
from sgstore.testsets.coverage import ChosenFrames, Classed
from sgstore.testsets.selection._cover import cheapest_alike
from sgstore.testsets.selection._sets import SetFamily
from sgstore.testsets.selection._units import (
    Holdings,
    SelectionUnit,
    Units,
    classes_of,
    kind_of,
    units_of,
)

if TYPE_CHECKING:
    from sgstore.collection import Collection
    from sgstore.query import Store
    from sgstore.testsets.selection._units import Measure


@dataclass(frozen=True)
class UnitsWished:
    """Definition of selection units (frames, clips or traces), as plain values for another process."""

    unit: str
    clip_s: float
    stride_s: float | None
    abstraction: str
    objective: Measure
    seed: int


def cheapest_units(
    chosen: ChosenFrames, whole: Collection, wish: UnitsWished
) -> tuple[Units, Holdings]:
    """Return the cheapest clip (or frame or trace) for each set of scene classes in each bundle (store).

    Parameters
    ----------
    chosen : ChosenFrames
    whole : Collection
        Collection of the frames.
    wish : UnitsWished
        Its clips share no frames.

    Raises
    ------
    AbstractionError, ConfigError
        As for a single store.
    """
    asked: dict[str, Any] = dict.fromkeys(whole.bundles())
    if chosen.frame_id is not None:
        asked = {name: of.tolist() for name, (_, of) in whole.file.by_bundle(chosen.frame_id)}
    how, total = asdict(wish), 0
    often: dict[str, int] = {}
    units: list[tuple[list[int], list[int], list[bool], list[str]]] = []
    each = {bundle: {"frames": frames, "wish": how} for bundle, frames in asked.items()}
    for _, told in whole.each(cheapest_in, each):
        total += told["total"]
        units += told["units"]
        for name, frames in told["often"].items():
            often[name] = often.get(name, 0) + frames
    units.sort(key=lambda one: one[0][0])
    end = np.cumsum([len(ids) for ids, *_ in units], dtype=np.int64)
    made = Units(
        chosen,
        SelectionUnit(wish.unit),
        np.array([one for ids, *_ in units for one in ids], np.int64),
        np.array([one for _, _, asked, _ in units for one in asked], np.bool_),
        np.array([one for _, times, *_ in units for one in times], np.int64),
        np.append(0, end)[:-1],
        end,
        others=total - len(units),
    )
    number = {name: place for place, name in enumerate(sorted(often))}
    pairs = [(unit, number[name]) for unit, (*_, held) in enumerate(units) for name in held]
    frames = np.array([often[name] for name in number], np.int64)
    kind = kind_of(wish.abstraction)
    return made, Holdings(
        None, np.array(pairs, np.int64).reshape(-1, 2).T, np.ones_like(frames), frames, kind
    )


def cheapest_in(store: Store, frames: list[int] | None, wish: dict[str, Any]) -> dict[str, Any]:
    """Return the cheapest clip (or frame or trace) for each set of scene classes in one bundle (store file)."""
    how = UnitsWished(**wish)
    chosen = ChosenFrames("", store, None if frames is None else np.array(frames, np.int64))
    units = units_of(chosen, SelectionUnit(how.unit), how.clip_s, how.stride_s)
    of = _classed(chosen, how.abstraction)
    present = of.present()
    names = [of.names[code] for code in present.tolist()]
    cost, rank = units.costs(how.objective), units.ranks(how.seed)
    family = SetFamily.of(classes_of(units, of), len(units), len(names), cost, rank=rank)
    told: list[Any] = []
    for one in np.flatnonzero(cheapest_alike(family)).tolist():
        rows = slice(units.begin[one], units.end[one])
        columns = units.frame_id[rows], units.log_time_ns[rows], units.asked[rows]
        told.append((*(c.tolist() for c in columns), [names[e] for e in family.elements(one)]))
    often = dict(zip(names, of.sizes()[present].tolist(), strict=True))
    return {"total": len(units), "units": told, "often": often}


def _classed(chosen: ChosenFrames, abstraction: str) -> Classed:
    """Return frames with their scene classes. Missing classes are computed, but not stored."""
    with working_folder("classes") as folder:
        part = PartFile.of_coded(chosen.one_store.file, abstraction, folder / "classes.parquet")
        of = PartFile.merged_classes([part])
    rows = chosen.rows_of(of.frame_id)
    return Classed(chosen, of.names, of.frame_id[rows], of.code[rows])
