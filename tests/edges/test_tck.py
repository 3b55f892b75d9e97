"""The script that counts which queries of openCypher's Technology Compatibility Kit are sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import tck

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

FEATURE = '''
Feature: Match

  Scenario: [1] Reads
    Given an empty graph
    When executing query:
      """
      MATCH (n)
      RETURN n
      """
    Then the result should be, in any order:
      | n |

  Scenario: [2] Writes
    When executing query:
      """
      CREATE (n)
      """

  Scenario: [3] Unwinds
    When executing query:
      """
      UNWIND [1, 2] AS x
      RETURN x
      """

  Scenario: [4] Is wrong
    When executing query:
      """
      MATCH (n RETURN n
      """
    Then a SyntaxError should be raised at compile time: Whatever
'''


def test_queries_that_read_are_counted_and_of_others_the_reason_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "match").mkdir()
    (tmp_path / "match" / "Match1.feature").write_text(FEATURE)

    tck.main(str(tmp_path), "--list")

    assert tck.reading_queries(FEATURE) == ["MATCH (n)\nRETURN n", "UNWIND [1, 2] AS x\nRETURN x"]
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "1 of 2 reading queries in 1 files are sentences of SGQL"
    assert told[1].split() == ["1", "found", "'UNWIND'"]
