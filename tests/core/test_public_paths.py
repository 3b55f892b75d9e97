"""Paths are given to the library as texts or as paths, as one likes; its errors are its own."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import sgstore
from sgstore.apps.demo import RECORDING
from sgstore.errors import SgstoreError
from sgstore.maps.opendrive import read_map
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator

PUBLIC = {
    "sgstore": (),
    "sgstore.query": ("Store",),
    "sgstore.draw": ("draw_frame", "draw_map", "draw_stored", "draw_clip"),
    "sgstore.testsets.locks": (),
    "sgstore.testsets.coverage": (),
    "sgstore.testsets.selection": (),
    "sgstore.exporters": ("write_export", "Recorder"),
    "sgstore.apps.record": ("record",),
    "sgstore.ingest": (),
    "sgstore.maps.map_files": ("read_map_file",),
    "sgstore.pipeline.importing": (),
    "sgstore.model.config": ("load",),
    "sgstore.apps.demo": ("run_demo",),
}
"""Modules that people call, with what of them; empty: all that they name in ``__all__``."""


def functions() -> Iterator[Any]:
    for module, names in PUBLIC.items():
        held = importlib.import_module(module)
        for name in names or held.__all__:
            one = getattr(held, name)
            if inspect.isclass(one):
                own = {key: getattr(it, "__func__", it) for key, it in vars(one).items()}
                every = {"__init__": one.__init__} | own
                found = {f"{name}.{key}": it for key, it in every.items() if _is_public(one, key)}
            else:
                found = {name: one}
            for key, it in found.items():
                if inspect.isfunction(it):
                    yield pytest.param(it, id=f"{module}.{key}")


def _is_public(kind: type, name: str) -> bool:
    made_by_us = hasattr(kind, "__dataclass_fields__")
    return not name.startswith("_") or (name == "__init__" and not made_by_us)


@pytest.mark.parametrize("function", [*functions()])
def test_nothing_that_people_call_asks_for_a_path_and_refuses_its_text(function: Any) -> None:
    told = {name: str(p.annotation) for name, p in inspect.signature(function).parameters.items()}

    assert {
        name
        for name, kind in told.items()
        if "Path" in kind and "str" not in kind and "Callable" not in kind
    } == set()


def test_pictures_are_drawn_into_a_file_that_is_named_by_a_text(
    town_store: Path, tmp_path: Path
) -> None:
    from sgstore.draw import draw_clip, draw_map, draw_stored

    store = sgstore.open(str(town_store))
    there = [str(tmp_path / name) for name in ("x.png", "x.svg", "x.gif", "map.png")]

    draw_stored(store, "town#3", there[0], camera="none")
    draw_stored(store, "town#3", there[1], camera="none")
    draw_clip(store, ("town#3", "town#4"), there[2], camera="none")
    name, text = store.file.road_map_text("town") or ("", "")
    draw_map(read_map(text, name), there[3])
    store.sql("SELECT 1 AS one").csv(str(tmp_path / "x.csv"))
    store.sql("SELECT 1 AS one").parquet(str(tmp_path / "x.parquet"))

    assert all(Path(one).stat().st_size > 100 for one in there)


@pytest.mark.parametrize("name", ["\udcff.sgstore", "a\0b.sgstore", "none.sgstore", ".", "odd.txt"])
def test_a_store_that_cannot_be_opened_is_an_error_of_ours(name: str, tmp_path: Path) -> None:
    from sgstore.apps.sandbox import Sandbox
    from sgstore.ingest import ingest
    from sgstore.pipeline.derive import derive
    from sgstore.store import StoreFile

    (tmp_path / "odd.txt").write_text("no store")
    path = f"{tmp_path}/{name}"
    ways: list[Any] = [sgstore.open, StoreFile, Store, Sandbox, lambda at: derive(at, None, "x")]
    if name != "none.sgstore":
        ways += [lambda at: ingest(at, [RECORDING], until=0.1), StoreFile.create]

    for way in ways:
        with pytest.raises(SgstoreError):
            way(path)
