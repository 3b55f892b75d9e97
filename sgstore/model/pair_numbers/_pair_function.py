"""Declaration of a measure of an object pair: its name, unit, description and SQL expression."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PairFunction:
    """Declaration of a measure of two objects a and b, such as gap or time to collision.

    Attributes
    ----------
    doc : str
        Meaning, in terms of a and b.
    unit : str
    sql : str
        Expression over columns of both entities, parts (:data:`_PARTS`) and other numbers; empty
        for a number that is looked up elsewhere and is not a column of the view.
    note : str
        Special values.
    source : str
        Its definition in the literature.
    view : str
        The first view with it as a column: ``pairs``, or ``criticality``, which has all.
    column : str
        Name in the views, if it differs.
    alias : str
        Second name in the language.
    worse : str
        The more critical values: ``low`` or ``high``; empty for neither.
    dear : bool
        True if its conditions are tested after other conditions, and after a bound on the distance.
    """

    doc: str
    unit: str
    sql: str
    note: str = ""
    source: str = ""
    view: str = "pairs"
    column: str = ""
    alias: str = ""
    worse: str = ""
    dear: bool = False

    @property
    def meaning(self) -> str:
        """Description of the measure in one line."""
        return f"{self.doc}; {self.unit}" + (f"; {self.note}" if self.note else "")


def measure(
    doc: str, unit: str, sql: str, note: str, source: str, alias: str = "", worse: str = "low"
) -> PairFunction:
    """Declare a measure of two objects, such as time to collision."""
    return PairFunction(doc, unit, sql, note, source, "criticality", alias=alias, worse=worse)
