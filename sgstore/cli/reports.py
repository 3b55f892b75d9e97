"""What is known of a recording, for people: a line a fact, and below it what needs more than one."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final

from sgstore.cli.output import GAP

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

_MANY: Final = 20
"""Losses and warnings that are listed; the others are counted."""


def write_report(values: dict[str, Any]) -> None:
    """Print what is known of a recording on stdout.

    Parameters
    ----------
    values : dict
        What :meth:`sgstore.store.StoredTrace.as_dict` with its report, or
        :meth:`sgstore.ingest.Examination.as_dict` tells; what is missing or empty is left out.
    """
    facts = [(name, text) for name, text in _facts(values) if text]
    width = max((len(name) for name, _ in facts), default=0)
    lines = [f"{name.ljust(width)}{GAP}{_shown(text)}" for name, text in facts]
    for title, items in _lists(values):
        lines += ["", f"{title}:", *(f"{GAP}{_shown(item)}" for item in items)]
    sys.stdout.writelines(f"{line}\n" for line in lines)


def _facts(values: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "trace", values.get("name", "")
    yield "trace_id", str(values.get("trace_id", ""))
    yield "file", f"{values['path']} ({_amount(values['size'])})"
    yield "sha256", values.get("digest", "")
    yield "flavour", values.get("flavour", "")
    yield "ego", values.get("ego", "")
    yield "road map", values.get("map", "") or values.get("road_map", "")
    yield "frames", _frames(values)
    yield "part", _part(values)
    yield "entities", _counts(values.get("entities", {}))
    yield "unknown types", _counts(values.get("unknown_types", {}))
    for name in ("clock_jumps", "gaps"):
        if values.get("frames"):
            yield name.replace("_", " "), _steps(values, name)
    yield "lost", _lost(values.get("losses", []))
    ingested = values.get("ingested_at")
    yield (
        "ingested",
        f"{ingested:%Y-%m-%d %H:%M:%S} UTC, sgstore {values['version']}" if ingested else "",
    )
    yield "cannot be read", values.get("error", "")


def _lists(values: dict[str, Any]) -> Iterator[tuple[str, list[str]]]:
    channels = values.get("channels", [])
    if channels:
        yield "channels", list(_channels(channels))
    for title, items in (
        ("losses", [_loss(loss) for loss in values.get("losses", [])]),
        ("warnings", list(values.get("warnings", []))),
    ):
        more = [f"… and {len(items) - _MANY} more"] if len(items) > _MANY else []
        if items:
            yield title, items[:_MANY] + more


def _frames(values: dict[str, Any]) -> str:
    count = values.get("frames", 0)
    if not count:
        return ""
    seconds = values.get("seconds", (values.get("end_ns", 0) - values.get("start_ns", 0)) / 1e9)
    period = values.get("period_ns", 0) / 1e9
    return f"{count}, {seconds:g} s" + (f", mostly every {period:g} s" if period else "")


def _part(values: dict[str, Any]) -> str:
    since, until = values.get("since"), values.get("until")
    parts = [f"from {since:g} s"] if since is not None else []
    parts += [f"to {until:g} s"] if until is not None else []
    rate = values.get("settings", {}).get("rate", 0)
    parts += [f"{rate:g} frames a second"] if rate else []
    return ", ".join(parts)


def _counts(counts: dict[str, int]) -> str:
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} {name}" for name, count in ordered)


def _steps(values: dict[str, Any], name: str) -> str:
    count, first = values.get(name, 0), values.get(f"{name}_at", [])
    places = ", ".join(f"{s['seconds']:+g} s before #{s['seq']} ({s['t']:g} s)" for s in first[:5])
    more = f", … ({count} in all)" if count > 5 else ""
    return f"{count}: {places}{more}" if count and first else str(count)


def _lost(losses: list[dict[str, Any]]) -> str:
    if not losses:
        return ""
    messages = sum(max(loss["messages"], 0) for loss in losses)
    size = sum(max(loss["bytes"], 0) for loss in losses)
    unknown = any(loss["messages"] < 0 for loss in losses)
    return f"{'at least ' if unknown else ''}{messages} messages, {_amount(size)}"


def _loss(loss: dict[str, Any]) -> str:
    told = [loss["reason"]]
    if loss["messages"] >= 0:
        told.append(f"{loss['messages']} messages")
    if loss["bytes"] >= 0:
        told.append(_amount(loss["bytes"]))
    if loss["start_ns"] >= 0:
        told.append(f"log times {loss['start_ns'] / 1e9:.3f} … {loss['end_ns'] / 1e9:.3f} s")
    if loss["offset"] >= 0:
        told.append(f"byte {loss['offset']} of the file")
    return "; ".join(told)


def _channels(channels: Iterable[dict[str, Any]]) -> Iterator[str]:
    rows = [
        (
            channel["topic"],
            channel["schema"] or channel["message_encoding"] or "no schema",
            channel.get("role") or "",
            f"{channel['messages']} messages" if channel.get("messages", -1) >= 0 else "",
        )
        for channel in channels
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield GAP.join(cells).rstrip()


def _amount(size: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return f"{size} bytes"


def _shown(text: str) -> str:
    """Texts come from files: what would move a terminal's cursor is not printed."""
    return "".join(c if c.isprintable() else "�" for c in text)
