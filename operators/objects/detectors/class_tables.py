"""What the classes of a network are called."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path

from mapstream.streams.coco import COCO_CLASSES
from mapstream.streams.errors import ConfigError

_UNUSED = frozenset({0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83})  # numbers of COCO with no class
_COCO_NAMES = iter(COCO_CLASSES)
COCO_NUMBERED = tuple("" if number in _UNUSED else next(_COCO_NAMES) for number in range(91))
"""COCO by the numbers of its annotations, as torchvision has them: 91, some of which stand for nothing."""


def class_table(
    name: str, file: Path | None, metadata: Mapping[str, str], num_classes: int | None
) -> tuple[str, ...]:
    """Return the names of a network's classes.

    They are those of a text file, or else of the network's own metadata, or else COCO's if their number is.

    Args:
        name: Of the network, for errors.
        file: One name a line.
        metadata: `names` is a dictionary or a list, as Ultralytics writes it.
        num_classes: None, if the network's outputs do not tell.

    Raises:
        ConfigError: If there is no table, or one of another length.
    """
    if file is not None:
        table, place = read_names(file), str(file)
    elif "names" in metadata:
        table, place = _of_metadata(name, metadata["names"]), f"the `names` in {name}"
    elif num_classes is None:
        return COCO_NUMBERED
    elif num_classes == len(COCO_CLASSES):
        return COCO_CLASSES
    else:
        raise ConfigError(
            f"{name}: no names for its {num_classes} classes; give a text file with one a line as `class_names`"
        )
    if num_classes is not None and len(table) != num_classes:
        raise ConfigError(
            f"{name}: {num_classes} classes, but {place} names {len(table)}; expected one name for each class"
        )
    return table


def read_names(file: Path) -> tuple[str, ...]:
    """Return the names of classes in a text file, one a line.

    Raises:
        ConfigError: If it cannot be read.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: expected names of classes, one a line: {error}") from error
    return tuple(line.strip() for line in lines if line.strip())


def _of_metadata(name: str, text: str) -> tuple[str, ...]:
    try:
        found = ast.literal_eval(text)
        numbered = found if isinstance(found, dict) else dict(enumerate(found))
        return tuple(str(numbered[number]) for number in range(len(numbered)))
    except (ValueError, SyntaxError, TypeError, KeyError) as error:
        raise ConfigError(
            f"{name}: expected `names` of its classes by number, found {text[:60]!r}; give a text file with one a"
            " line as `class_names`"
        ) from error
