"""Failures of a tested system, compared with the scene classes of its training and test inputs."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import ConfigError
from sgstore.testsets.coverage._chosen_frames import names_of
from sgstore.testsets.coverage._classes import shared
from sgstore.testsets.coverage._frames import SHARES, ReportTable, of_unknown, share

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.model.world import Bools, Ints
    from sgstore.testsets.coverage._chosen_frames import ChosenFrames
    from sgstore.testsets.coverage._classes import Classed

# Woodlief et al., "S3C: Spatial Semantic Scene Coverage for Autonomous Vehicles" (ICSE 2024),
# section 4.2. A *novel failure* is a failing test input whose class has no failing training input.
# PNFNC is the share of novel failures whose class has no training input at all: failures that
# coverage could predict.

S3C_THRESHOLD: Final = 5 / 140
"""Error of the steering angle (-1 … 1 for ±70°) that S3C counts as failure: 2.5° in code, 5° in the paper."""

_ID: Final = re.compile(r"[0-9]{1,19}")


def read_outcomes(path: str | Path, threshold: float = S3C_THRESHOLD) -> dict[str, bool]:
    """Read test outcomes from a CSV file: name of the input → True for a failure.

    Parameters
    ----------
    path : str or Path
        Columns ``frame`` (or S3C's ``town`` and ``filename``) and ``failed``, or ``error``, or ``label`` and
        ``pred``.
    threshold : float
        A greater error is a failure; for ``label`` and ``pred`` the error is their difference.

    Returns
    -------
    dict
        Name → True for a failure. A name is ``TRACE#SEQ``, a ``frame_id``, or the name of a graph
        in an imported file.

    Raises
    ------
    ConfigError
        The file is unreadable, a column is missing, or a row is invalid.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return dict(_outcomes(path, csv.reader(file, strict=True), threshold))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: no CSV: {error}") from error


def told_outcomes(
    outcomes: Mapping[str, bool], chosen: ChosenFrames, frame_id: Ints
) -> tuple[Bools, Bools]:
    """Return two masks of the frames, (N,): with a failed test, and with a known test result."""
    failed, known = (np.zeros(len(frame_id), np.bool_) for _ in range(2))
    place = {int(frame): row for row, frame in enumerate(frame_id.tolist())}
    ids = chosen.abstracted.times()[0]
    called = dict(zip(names_of(chosen.store, ids), ids.tolist(), strict=True))
    called |= chosen.abstracted.imported_names()
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
    """Return two tables of test failures: shares, and failures in scene classes that training lacks.

    Parameters
    ----------
    train, test : Classed
    outcomes : mapping
        Name of a frame → True for a failure; see :func:`read_outcomes`.

    Returns
    -------
    shares : ReportTable
        ``measure``, ``part``, ``of``, ``share``, ``denominator``.
    novel : ReportTable
        The novel failures: ``frame``, ``class``, ``in_training`` (number of training inputs of the
        class).

    Raises
    ------
    ConfigError
        The outcomes match no frame of either selection.
    """
    _, (train, test) = shared(train, test)
    failed_train, known_train = told_outcomes(outcomes, train.chosen, train.frame_id)
    failed, known = told_outcomes(outcomes, test.chosen, test.frame_id)
    if not known.any():
        raise ConfigError(
            f"none of the {len(outcomes)} outcomes is about a frame of {test.chosen.text}"
        )
    failed &= test.known
    failed_train &= train.known
    # Number of training inputs of each test input's class.
    inputs = np.append(train.sizes(), 0)[test.code]
    fails = np.bincount(train.code[failed_train], minlength=len(train.names) + 1)
    novel = failed & (fails[test.code] == 0)
    ours, theirs = test.chosen.text, train.chosen.text
    classes, first = np.unique(test.code[novel], return_index=True)
    lacking = inputs[novel][first] == 0
    told = [f"frames of {name} with an outcome" for name in (ours, theirs)]
    new = f"failures of {ours}: no failing frame of their class in {theirs}"
    uncovered, once = novel & (inputs == 0), novel & (inputs == 1)
    facts = (
        ("failures", failed, known & test.known, told[0]),
        ("failures in training", failed_train, known_train & train.known, told[1]),
        ("novel failures", novel, failed, new),
        # The next rows show how many of them coverage could predict.
        ("PNFNC", uncovered, novel, f"novel failures: their class does not occur in {theirs}"),
        (
            "classes of novel failures that are not covered",
            lacking,
            np.ones(len(classes)),
            "distinct classes of novel failures",
        ),
        (
            "novel failures of a class seen once",
            once,
            novel,
            f"novel failures: their class has one frame in {theirs}",
        ),
        (
            "test inputs not covered",
            test.known & (inputs == 0),
            test.known,
            f"frames of {ours} with a class",
        ),
    )
    rows = [share(name, int(part.sum()), int(of.sum()), text) for name, part, of, text in facts]
    said = of_unknown(test.unknown, ours) + of_unknown(train.unknown, theirs)
    said += [f"{int((~known).sum())} frames of {ours} have no outcome"] if (~known).any() else []
    return ReportTable(SHARES, rows, said), _listed(test, novel, inputs)


def _listed(test: Classed, novel: Bools, inputs: Ints) -> ReportTable:
    rows = np.flatnonzero(novel)
    frames = names_of(test.chosen.store, test.frame_id[rows])
    columns = zip(frames, test.code[rows].tolist(), inputs[rows].tolist(), strict=True)
    listed = [(frame, test.names[code], many) for frame, code, many in columns]
    return ReportTable(("frame", "class", "in_training"), listed)
