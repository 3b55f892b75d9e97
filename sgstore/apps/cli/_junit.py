"""Verdicts as JUnit XML for build servers: one test per check and trace."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.base.display import number_of
from sgstore.base.output_files import write_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.matches import Interval
    from sgstore.temporal import Verdict

_NO_XML: Final = re.compile(r"[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Regular expression of characters that XML does not allow, not even as references."""


def clip_of(span: Interval) -> str:
    """Return the name of a clip with the frames of a violation, such as ``town#120..160``."""
    return f"{span.trace}#{span.start_seq}..{span.end_seq}"


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for violations in reports: a command that shows the violation, and a picture.

    Attributes
    ----------
    store : str
    pictures : mapping of str to str
        Clip of a violation → its picture.
    """

    store: str
    pictures: Mapping[str, str] = field(default_factory=dict[str, str])

    def of(self, span: Interval) -> dict[str, str]:
        """Return the clip of a violation, the command that shows it, and its picture if there is one."""
        clip = clip_of(span)
        show = ["sgstore", "show", self.store, f"{span.trace}#{span.start_seq}"]
        found = {"clip": clip, "command": shlex.join(show)}
        return found | ({"picture": self.pictures[clip]} if clip in self.pictures else {})


def write_junit(path: Path, verdicts: Iterable[Verdict], evidence: Evidence) -> None:
    """Write verdicts as a JUnit XML file: a test suite for each check, with a case for each trace.

    A violated check is a failure whose text names each violation. A trace that cannot answer, or a
    pending verdict, is skipped. A passed case contains the number of frames without an entity.

    Parameters
    ----------
    path : Path
    verdicts : iterable of Verdict
    evidence : Evidence

    Raises
    ------
    ExportError
        The file cannot be written; an existing file stays unchanged.
    """
    from xml.etree import ElementTree as Xml  # few need it

    from sgstore.temporal import absence_text

    root = Xml.Element("testsuites", name="sgstore check")
    suites: dict[str, Xml.Element] = {}
    for one in verdicts:
        name = _plain(one.check)
        if name not in suites:
            suites[name] = Xml.SubElement(root, "testsuite", name=name)
        case = Xml.SubElement(suites[name], "testcase", classname=name, name=_plain(one.trace))
        if one.violated:
            lines = _violations(one, evidence)
            count = f"{len(lines)} violation{'s' * (len(lines) != 1)}"
            Xml.SubElement(case, "failure", message=count).text = "\n".join(lines)
        elif one.verdict != "true":
            Xml.SubElement(case, "skipped", message=_plain(one.reason or _word(one)))
        elif one.absent_frames or one.never_applied:
            absent = absence_text(one.absent_frames) if one.absent_frames else ""
            told = "; ".join(filter(None, [absent, one.never_applied]))
            Xml.SubElement(case, "system-out").text = told
    for element, cases in [(root, root.findall("*/*")), *((s, list(s)) for s in suites.values())]:
        element.set("tests", str(len(cases)))
        element.set("failures", str(sum(case.find("failure") is not None for case in cases)))
        element.set("errors", "0")
        element.set("skipped", str(sum(case.find("skipped") is not None for case in cases)))
    Xml.indent(root)
    write_bytes(path, Xml.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _word(verdict: Verdict) -> str:
    """Return the verdict of a check as text for a report, without its reason."""
    return (
        "pending at the end of the recording" if verdict.verdict == "pending" else verdict.verdict
    )


def _violations(verdict: Verdict, evidence: Evidence) -> list[str]:
    """Return a text line for each violation of a check: its frames, times, values and evidence."""
    from sgstore.temporal import false_text

    return [
        _plain(
            f"{one.trace}#{one.start_seq}-{one.end_seq}, {one.start:.3f} to {one.end:.3f} s,"
            f" {number_of(one.frames, 'frame')}{false_text(one)}"
            + "".join(f", {name} {value}" for name, value in one.values.items())
            + "".join(f"; {name}: {value}" for name, value in evidence.of(one).items())
        )
        for one in verdict.violations
    ]


def _plain(text: str) -> str:
    """Return a text in which characters that XML does not allow are replaced by escapes."""
    return _NO_XML.sub(lambda found: f"\\x{ord(found[0]):02x}", text)
