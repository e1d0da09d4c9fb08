"""Write one page per operator from its docstring, ports and options: `python docs/build_operator_pages.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mapstream.graph.catalogue import BUILT_IN, Catalogue
from mapstream.graph.cli.operators import describe

FOLDER = Path(__file__).parent / "operators"


def _table(columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [columns, tuple("---" for _ in columns), *rows]
    return "\n".join(
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines
    )


def page(found: dict[str, Any]) -> str:
    """Return the Markdown page of one operator."""
    parts = [
        f"# {found['name']}",
        found["documentation"],
        f"Runs {found['placement']} unless the graph says otherwise.",
    ]
    for ends in ("inputs", "outputs"):
        if found[ends]:
            rows = [(f"`{p['name']}`", f"`{p['type']}`", p["note"]) for p in found[ends]]
            parts += [f"## {ends.capitalize()}", _table(("port", "message", ""), rows)]
    if found["has_ports_by_config"]:
        parts.append("More ports come from its config.")
    if found["options"]:
        rows = [
            (f"`{o['name']}`", f"`{o['type']}`", f"`{o['default']}`", o["meaning"])
            for o in found["options"]
        ]
        parts += ["## Config", _table(("option", "type", "default", "meaning"), rows)]
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Return all pages by file name."""
    catalogue = Catalogue()
    found = {name: describe(catalogue, name) for name in sorted(BUILT_IN)}
    rows = [(f"[`{n}`]({n}.md)", f["documentation"].partition("\n")[0]) for n, f in found.items()]
    index = f"# Operators\n\nMade by `docs/build_operator_pages.py` from the code.\n\n{_table(('name', ''), rows)}\n"
    return {"index.md": index} | {f"{name}.md": page(f) for name, f in found.items()}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in pages().items():
        (FOLDER / name).write_text(text)
