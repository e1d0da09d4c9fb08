"""Run benchmarks by name and print their tables: `python benchmarks/run.py [NAME ...]`.

Each module beside this file is one benchmark. Its `run()` returns rows of ratios, both sides measured in
the same process and run, since absolute times of one machine say little about another.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parent))
NAMES = sorted(p.stem for p in FOLDER.glob("*.py") if p.stem not in ("run", "table", "__init__"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=NAMES, choices=[*NAMES, []], metavar="NAME")
    names = parser.parse_args().names
    from benchmarks.table import markdown  # noqa: PLC0415  # needs the path above

    commit = subprocess.run(  # a fixed command
        ["git", "rev-parse", "--short", "HEAD"],  # noqa: S607
        cwd=FOLDER,
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    python = platform.python_version()
    print(f"Commit {commit}, Python {python}, {platform.machine()}, {os.cpu_count()} cores.\n")
    for name in names:
        rows = importlib.import_module(f"benchmarks.{name}").run()
        print(f"## {name}\n\n{markdown(rows)}\n", flush=True)


if __name__ == "__main__":
    main()
