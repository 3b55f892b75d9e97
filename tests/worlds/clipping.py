"""Clips of recordings without a store: a stand-in says where a recording is, and what its messages need."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

from sgstore.exporters import Export, write_export
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.model.world import Clip, MessageRefs


class Source(NamedTuple):
    """What an export asks of a trace, and the messages that later ones depend on."""

    path: Path
    digest: str
    context: MessageRefs
    period_ns: int = 0


def source(path: Path) -> Source:
    with open_trace(path) as trace:
        return Source(path, trace.info.digest, trace.info.context)


def write_clips(
    clips: Sequence[Clip],
    sources: Mapping[str, Source],
    to: Path,
    *,
    rebased: bool = False,
    **provenance: str,
) -> list[Any]:
    """Cut clips out of recordings, by the name of their trace."""
    file = SimpleNamespace(
        trace=sources.__getitem__,
        context=lambda name: sources[name].context,
        snapshot=nullcontext,
    )
    store: Any = SimpleNamespace(file=file)
    order = Export(store, tuple(clips), rebase_context=rebased, provenance=provenance)
    return write_export(order, to)
