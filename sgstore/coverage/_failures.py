"""Failures of a system under test by the classes of its inputs: S3C's novel failures.

Woodlief et al., "S3C: Spatial Semantic Scene Coverage for Autonomous Vehicles" (ICSE 2024), section 4.2. A
*novel failure* is a failing test input whose class has no failing training input. PNFNC is the share of novel
failures whose class has no training input at all: failures that coverage would have foretold.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.coverage._classes import shared
from sgstore.coverage._frames import SHARES, ReportTable, names_of, of_unknown, share
from sgstore.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.coverage._classes import Classed
    from sgstore.coverage._frames import Row
    from sgstore.world import Bools, Ints


S3C_THRESHOLD: Final = 5 / 140
"""The error beyond which S3C's code counts a steering angle, -1 … 1 for ±70°, as a failure: 2.5°, though its
paper says 5°."""

_ID: Final = re.compile(r"[0-9]{1,18}")


def read_outcomes(path: str | Path, threshold: float = S3C_THRESHOLD) -> dict[str, bool]:
    """The outcomes in a CSV file: which inputs of a system failed.

    Parameters
    ----------
    path : str or Path
        Columns ``frame`` (or S3C's ``town`` and ``filename``) and ``failed``, or ``error``, or ``label`` and
        ``pred``.
    threshold : float
        An error above it is a failure; of ``label`` and ``pred`` their difference.

    Returns
    -------
    dict
        Name → whether it failed. A name is ``TRACE#SEQ``, a ``frame_id``, or what an imported file calls a
        graph.

    Raises
    ------
    ConfigError
        It cannot be read, a column is missing, or a row is not what it must be.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return dict(_outcomes(path, csv.reader(file, strict=True), threshold))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: no CSV: {error}") from error


def _told(outcomes: Mapping[str, bool], a: Classed) -> tuple[Bools, Bools]:
    """(N,): which frames of a selection failed, and of which an outcome is known."""
    failed, known = (np.zeros(len(a.frame_id), np.bool_) for _ in range(2))
    place = {int(frame): row for row, frame in enumerate(a.frame_id.tolist())}
    store = a.chosen.store
    ids = store.file.abstracted.times()[0]
    called = dict(zip(names_of(store, ids), ids.tolist(), strict=True))
    called |= store.file.abstracted.imported_names()
    for name, fails in outcomes.items():
        row = place.get(called.get(name, int(name) if _ID.fullmatch(name) else -1))
        if row is not None:
            failed[row], known[row] = fails, True
    return failed, known


def _outcomes(
    path: Path, rows: Iterator[list[str]], threshold: float
) -> Iterator[tuple[str, bool]]:
    header = [name.strip() for name in next(rows, [])]
    names = ["frame"] if "frame" in header else ["town", "filename"]
    values = next(
        (v for v in (["failed"], ["error"], ["label", "pred"]) if set(v) <= set(header)), None
    )
    if not set(names) <= set(header) or values is None:
        raise ConfigError(
            f"{path}: expected columns 'frame' (or 'town', 'filename') and 'failed' (or 'error', or 'label',"
            f" 'pred'); found {','.join(header)[:200]}"
        )
    at_name = [header.index(name) for name in names]
    at_value = [header.index(name) for name in values]
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        if len(row) != len(header):
            raise ConfigError(f"{path}: row {number}: {len(row)} columns, expected {len(header)}")
        told = [row[place].strip() for place in at_value]
        yield (
            "/".join(row[place].strip() for place in at_name),
            _failed(f"{path}: row {number}", values, told, threshold),
        )


_TRUE: Final = frozenset({"1", "true", "yes", "t", "failed", "fail"})
_FALSE: Final = frozenset({"0", "false", "no", "f", "passed", "pass", ""})


def _failed(where: str, columns: list[str], told: list[str], threshold: float) -> bool:
    if columns == ["failed"]:
        if told[0].lower() not in _TRUE | _FALSE:
            raise ConfigError(f"{where}, column failed: expected true or false, found {told[0]!r}")
        return told[0].lower() in _TRUE
    try:
        numbers = [float(text) for text in told]
    except ValueError:
        raise ConfigError(f"{where}: expected numbers, found {', '.join(told)!r}") from None
    return abs(numbers[0] if len(numbers) == 1 else numbers[1] - numbers[0]) > threshold


def failures(
    train: Classed, test: Classed, outcomes: Mapping[str, bool]
) -> tuple[ReportTable, ReportTable]:
    """Compare the failures of test inputs with the classes of training inputs.

    Parameters
    ----------
    train, test : Classed
    outcomes : mapping
        Name of a frame → whether the system failed; see :func:`read_outcomes`.

    Returns
    -------
    shares : ReportTable
        ``measure``, ``part``, ``of``, ``share``, ``denominator``.
    novel : ReportTable
        The novel failures: ``frame``, ``class``, ``in_training`` (how many training inputs are of its class).

    Raises
    ------
    ConfigError
        No outcome is about a frame of either.
    """
    _, (train, test) = shared(train, test)
    failed_train, known_train = _told(outcomes, train)
    failed, known = _told(outcomes, test)
    if not known.any():
        raise ConfigError(
            f"none of the {len(outcomes)} outcomes is about a frame of {test.chosen.text}"
        )
    failed &= test.known
    # Training inputs of the class of each test input.
    inputs = np.append(train.sizes(), 0)[test.code]
    fails = np.bincount(train.code[failed_train & train.known], minlength=len(train.names) + 1)
    novel = failed & (fails[test.code] == 0)
    ours, theirs = test.chosen.text, train.chosen.text
    counted = int((known_train & train.known).sum())
    rows = [
        share(
            "failures",
            int(failed.sum()),
            int((known & test.known).sum()),
            f"frames of {ours} with an outcome",
        ),
        share(
            "failures in training",
            int((failed_train & train.known).sum()),
            counted,
            f"frames of {theirs} with an outcome",
        ),
        share(
            "novel failures",
            int(novel.sum()),
            int(failed.sum()),
            f"failures of {ours}: no failing frame of their class in {theirs}",
        ),
        *_foretold(test, novel, inputs, theirs),
        share(
            "test inputs not covered",
            int((test.known & (inputs == 0)).sum()),
            int(test.known.sum()),
            f"frames of {ours} with a class",
        ),
    ]
    said = of_unknown(test.unknown, ours) + of_unknown(train.unknown, theirs)
    said += [f"{int((~known).sum())} frames of {ours} have no outcome"] if (~known).any() else []
    return ReportTable(SHARES, rows, said), _listed(test, novel, inputs)


def _foretold(test: Classed, novel: Bools, inputs: Ints, theirs: str) -> list[Row]:
    """Number of novel failures in classes that training lacks, or has once."""
    classes, first = np.unique(test.code[novel], return_index=True)
    lacking = inputs[novel][first] == 0
    return [
        share(
            "PNFNC",
            int((novel & (inputs == 0)).sum()),
            int(novel.sum()),
            f"novel failures: their class does not occur in {theirs}",
        ),
        share(
            "classes of novel failures that are not covered",
            int(lacking.sum()),
            len(classes),
            "distinct classes of novel failures",
        ),
        share(
            "novel failures of a class seen once",
            int((novel & (inputs == 1)).sum()),
            int(novel.sum()),
            f"novel failures: their class has one frame in {theirs}",
        ),
    ]


def _listed(test: Classed, novel: Bools, inputs: Ints) -> ReportTable:
    rows = np.flatnonzero(novel)
    frames = names_of(test.chosen.store, test.frame_id[rows])
    columns = zip(frames, test.code[rows].tolist(), inputs[rows].tolist(), strict=True)
    listed = [(frame, test.names[code], many) for frame, code, many in columns]
    return ReportTable(("frame", "class", "in_training"), listed)
