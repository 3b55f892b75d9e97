"""Violations as SARIF 2.1.0 for code scanning: one result per violation.

Source: OASIS Standard, "Static Analysis Results Interchange Format (SARIF) Version 2.1.0", 2020.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from sgstore.base.output_files import write_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.apps.cli._junit import Evidence
    from sgstore.temporal import Verdict, ViolationInterval

_SCHEMA: Final = "https://json.schemastore.org/sarif-2.1.0.json"
_PACKAGE: Final = "https://pypi.org/project/sgstore/"


def write_sarif(
    path: Path, verdicts: Iterable[Verdict], evidence: Evidence, recordings: Mapping[str, str]
) -> None:
    """Write violations as a SARIF file: a rule for each check, a result for each violation.

    A trace that cannot answer is a notification, not a result.

    Parameters
    ----------
    path : Path
    verdicts : iterable of Verdict
    evidence : Evidence
    recordings : mapping of str to str
        Trace name → its recording.

    Raises
    ------
    ExportError
        The file cannot be written; an existing file stays unchanged.
    """
    from importlib.metadata import version

    rules: dict[str, dict[str, Any]] = {}
    results: list[dict[str, Any]] = []
    notices: list[dict[str, Any]] = []
    for one in verdicts:
        if one.check not in rules:
            rules[one.check] = _rule(one.check)
        if one.verdict in {"unknown", "pending"}:
            text = f"{one.check} is {one.verdict} for {one.trace}"
            text = f"{text}: {one.reason}" if one.reason else text
            notices.append({"level": "note", "message": {"text": text}})
        results += (
            {
                "ruleId": one.check,
                "level": "error",
                "message": {"text": _message(span)},
                "locations": [_location(span.trace, recordings.get(span.trace, span.trace))],
                "partialFingerprints": {"violation": f"{one.check}/{span.trace}#{span.start_seq}"},
                "properties": {
                    "trace": span.trace,
                    "start": span.start,
                    "end": span.end,
                    "frames": span.frames,
                    "values": {name: str(value) for name, value in span.values.items()},
                    **evidence.of(span),
                },
            }
            for span in one.violations
        )
    driver = {
        "name": "sgstore check",
        "version": version("sgstore"),
        "informationUri": _address(),
        "rules": [*rules.values()],
    }
    run = {
        "tool": {"driver": driver},
        "invocations": [{"executionSuccessful": True, "toolExecutionNotifications": notices}],
        "results": results,
    }
    document = {"$schema": _SCHEMA, "version": "2.1.0", "runs": [run]}
    write_bytes(path, json.dumps(document, indent=1).encode() + b"\n")


def _message(span: ViolationInterval) -> str:
    from sgstore.temporal import false_text

    return f"{span.trace}, {span.start:.3f} to {span.end:.3f} s{false_text(span)}"


def _address() -> str:
    """Return the web address of the project's source code, or else of its package page."""
    from importlib.metadata import metadata

    links = metadata("sgstore").get_all("Project-URL") or []
    named = dict(link.split(", ", 1) for link in links)
    return named.get("Source", _PACKAGE)


def _rule(check: str) -> dict[str, Any]:
    """Return a check as a rule, with the sentence and the source of a library pattern."""
    from sgstore.lang.library import patterns

    rule: dict[str, Any] = {"id": check}
    entry = patterns().get(check)
    if entry is not None and entry.is_check:
        rule["shortDescription"] = {"text": entry.sentence}
        if entry.source:
            rule["help"] = {"text": f"Source: {entry.source}"}
    return rule


def _location(trace: str, recording: str) -> dict[str, Any]:
    path = Path(recording)
    if path.is_absolute() and path.is_relative_to(Path.cwd()):  # code scanning needs relative paths
        recording = path.relative_to(Path.cwd()).as_posix()
    return {
        "physicalLocation": {"artifactLocation": {"uri": quote(recording)}},
        "logicalLocations": [{"name": trace, "kind": "object"}],
    }
