"""Who may import whom, and how large a module may be."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapstream import streams
from mapstream.streams.messages import estimates, sensors

ROOT = Path(__file__).parents[1]
LAYERS = ("streams", "recordings", "operators", "graph")
MODULES = sorted(path for layer in LAYERS for path in (ROOT / layer).rglob("*.py"))
MAX_LINES = 400
DOORS = {  # a library, and the only places that may import it
    "gtsam": ("operators/estimation/",),
    "pyproj": ("operators/gnss/",),
    "rerun": ("graph/tap", "graph/views", "graph/blueprint"),
}


def _imports(module: Path) -> Iterator[str]:
    """Yield the dotted names that a module imports, at its top or inside a function."""
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _layer_of(name: str) -> str | None:
    parts = name.split(".")
    return parts[1] if parts[0] == "mapstream" and len(parts) > 1 and parts[1] in LAYERS else None


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_imports_only_from_those_to_its_left(layer: str) -> None:
    allowed = LAYERS[: LAYERS.index(layer) + 1]
    wrong = [
        f"{module.relative_to(ROOT)} imports {name}"
        for module in MODULES
        if module.relative_to(ROOT).parts[0] == layer
        for name in _imports(module)
        if _layer_of(name) not in (None, *allowed) or name.split(".")[0] in LAYERS
    ]

    assert wrong == []


def test_every_library_has_one_door() -> None:
    wrong = [
        f"{module.relative_to(ROOT)} imports {name}"
        for module in MODULES
        for name in _imports(module)
        for library, doors in DOORS.items()
        if name.split(".")[0] == library
        and not str(module.relative_to(ROOT).as_posix()).startswith(doors)
    ]

    assert wrong == []


def test_no_module_exceeds_its_size() -> None:
    lengths = {str(m.relative_to(ROOT)): len(m.read_text().splitlines()) for m in MODULES}

    assert {name: n for name, n in lengths.items() if n > MAX_LINES} == {}


def test_streams_import_stays_light() -> None:
    """A plugin that needs only messages and channels loads no heavy library."""
    program = (
        "import sys, mapstream.streams; print(*sorted(m for m in sys.modules if '.' not in m))"
    )

    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    ).stdout.split()

    heavy = {
        "scipy",
        "cv2",
        "rerun",
        "gtsam",
        "pyarrow",
        "pandas",
        "pydantic",
        "kiss_icp",
        "rosbags",
    }
    assert heavy.isdisjoint(loaded)


def test_every_message_is_exported() -> None:
    """A plugin author finds all that flows in `mapstream.streams`."""
    messages = {
        name
        for module in (sensors, estimates)
        for name, value in vars(module).items()
        if isinstance(value, type) and value.__module__ == module.__name__
    }

    assert messages - set(streams.__all__) == set()
