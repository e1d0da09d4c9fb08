"""Packages that look installed, without an installation."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path


def look_installed(site: Path, projects: Iterable[Path]) -> Path:
    """Fill a folder that, on Python's path, holds the packages of some `pyproject.toml` and their entry points."""
    for file in projects:
        project = tomllib.loads(file.read_text())
        name, version = project["project"]["name"], project["project"]["version"]
        info = site / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir(parents=True)
        for package in project["tool"]["setuptools"]["packages"]:
            (site / package).symlink_to(file.parent / package)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        lines = []
        for group, points in project["project"]["entry-points"].items():
            lines += [f"[{group}]", *(f"{key} = {value}" for key, value in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return site
