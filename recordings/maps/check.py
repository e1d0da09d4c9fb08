"""Check a map against all rules: `structure_rules.py` and `value_rules.py` hold one function each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.recordings.maps.findings import Finding, where
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.structure_rules import STRUCTURE_RULES, references_lead_somewhere
from mapstream.recordings.maps.value_rules import VALUE_RULES
from mapstream.streams.errors import MapCheckError

_MAX_PER_FINDING = 100  # rows that are listed; more say nothing new


@dataclass(frozen=True, slots=True)
class Violation:
    """One row that breaks a rule."""

    rule: str
    table: str
    row: int
    sentence: str

    def __str__(self) -> str:
        return f"{self.table}, row {self.row}: {self.sentence} ({self.rule})"


def check_map(map_: Map, folder: Path | str | None = None) -> list[Violation]:
    """Return what breaks the rules of maps, at most 100 rows of one kind.

    Args:
        map_: The map, with all its tables.
        folder: Where the map lies; its files are looked for, if given.
    """
    violations = _named("references_lead_somewhere", references_lead_somewhere(map_))
    if not violations:  # the rules below follow references
        for rule in STRUCTURE_RULES:
            violations += _named(rule.__name__, rule(map_))
    for rule in VALUE_RULES:
        violations += _named(rule.__name__, rule(map_))
    if folder is not None:
        violations += _named("files_are_there", _missing_files(map_, Path(folder)))
    return violations


def _named(rule: str, findings: Iterable[Finding]) -> list[Violation]:
    violations = []
    for finding in findings:
        rows = finding.rows.tolist()
        listed = rows[:_MAX_PER_FINDING]
        violations += [Violation(rule, finding.table, row, finding.say(row)) for row in listed]
        if len(rows) > _MAX_PER_FINDING:
            more = f"so do {len(rows) - _MAX_PER_FINDING} rows from here on"
            violations.append(Violation(rule, finding.table, rows[_MAX_PER_FINDING], more))
    return violations


def _missing_files(map_: Map, folder: Path) -> Iterable[Finding]:
    table = map_.resources
    is_file = [(folder / path).is_file() for path in table.path]
    broken = (table.topic == "") & ~np.array(is_file, dtype=bool)
    return where(broken, "resources", lambda row: f"{folder / table.path[row]} is missing")


def require_valid(map_: Map, folder: Path | str | None = None) -> Map:
    """Return the map if it keeps all rules.

    Raises:
        MapCheckError: If it breaks some; the message lists the first ten.
    """
    violations = check_map(map_, folder)
    if violations:
        shown = "\n  ".join(map(str, violations[:10]))
        raise MapCheckError(f"the map breaks {len(violations)} times its rules:\n  {shown}")
    return map_
