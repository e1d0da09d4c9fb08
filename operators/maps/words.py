"""What people type, against what things are called."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase


def matches(text: str, names: Iterable[str]) -> bool:
    """Return whether each word of a text is a word of one of the names, in any case; `*` and `?` stand for letters.

    `table` matches "kitchen table", `cup` does not match "cupboard", `cup*` does.
    """
    wanted = text.lower().split()
    return bool(wanted) and any(_has_all(wanted, name.lower()) for name in names)


def _has_all(wanted: list[str], name: str) -> bool:
    words = [name, *name.replace("_", " ").replace("-", " ").split(), *name.split()]
    return all(any(fnmatchcase(word, pattern) for word in words) for pattern in wanted)
