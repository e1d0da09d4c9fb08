"""A map on disk is the map, whole, or an error that says what to do."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.maps import Map, load_map, save_map
from mapstream.recordings.maps.columns import Column, columns_of
from mapstream.recordings.maps.combine import with_journal_entry
from mapstream.recordings.maps.folder import LOCK, FolderLock
from mapstream.recordings.maps.model import TABLES, from_tables
from mapstream.streams.errors import MapError, MapFormatError
from tests.full_disk import largest_file
from tests.recordings.made_maps import files_under, full_map, line_map

REPOSITORY = Path(__file__).parents[2]


@pytest.mark.parametrize(
    "map_", [Map.empty(), line_map(1), full_map()], ids=["empty", "one", "full"]
)
def test_S1_save_load_save_loses_nothing(map_: Map, tmp_path: Path) -> None:
    map_ = with_journal_entry(map_, "made", by="hand")
    save_map(map_, tmp_path / "a")

    loaded = load_map(tmp_path / "a")
    save_map(loaded, tmp_path / "b")

    assert loaded.digest() == map_.digest()
    first, second = files_under(tmp_path / "a"), files_under(tmp_path / "b")
    assert first.pop(LOCK) is not None
    assert second.pop(LOCK) is not None
    assert first == second


def any_column(column: Column, num_rows: int, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Values of a column that no rule but its type bounds: NaN, infinity, empty and strange texts."""
    shape = (num_rows, *column.shape)
    if column.kind == "text":
        return rng.choice(np.array(["", "a", "Kante-ß", "\n\0", "🤖"], dtype=object), shape)
    if column.kind == "bytes":
        return np.array([rng.bytes(int(rng.integers(9))) for _ in range(num_rows)], dtype=object)
    if column.kind.startswith("float"):
        values = rng.normal(size=shape) * 10.0 ** rng.integers(-300, 300, shape)
        special = rng.choice([1.0, np.nan, np.inf, -0.0], shape)
        with np.errstate(over="ignore"):
            return np.asarray(values * special, dtype=column.dtype)
    low, high = (0, 2) if column.kind == "bool" else (0, 256)
    return rng.integers(low, high, shape).astype(column.dtype)


@settings(max_examples=6, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.integers(0, 6), min_size=len(TABLES), max_size=len(TABLES)),
)
def test_S1_whatever_a_map_holds_comes_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, sizes: list[int]
) -> None:
    """Every column of every table, at any length."""
    folder, rng = tmp_path_factory.mktemp("map"), np.random.default_rng(seed)
    map_ = from_tables(
        {
            name: table(**{c.name: any_column(c, size, rng) for c in columns_of(table)})
            for (name, table), size in zip(TABLES.items(), sizes, strict=True)
        }
    )
    save_map(map_, folder / "a")

    loaded = load_map(folder / "a")
    save_map(loaded, folder / "b")

    assert loaded.digest() == map_.digest() == load_map(folder / "b").digest()


def test_S1_a_part_of_the_tables_can_be_loaded(tmp_path: Path) -> None:
    map_ = full_map()
    save_map(map_, tmp_path)

    part = load_map(tmp_path, tables=["missions", "vertices"])

    assert part.digest() == Map(missions=map_.missions, vertices=map_.vertices).digest()
    with pytest.raises(ValueError, match=r"no tables \['clouds'\]; a map has"):
        load_map(tmp_path, tables=["clouds"])


def test_unknown_kinds_and_payloads_survive(tmp_path: Path) -> None:
    map_ = line_map(3)
    kinds = np.array(["sonar_range", "Kante-ß"], dtype=object)
    payload = np.array([b"\x00\x01", b""], dtype=object)
    map_ = replace(map_, edges=replace(map_.edges, kind=kinds, payload=payload))
    save_map(map_, tmp_path)

    edges = load_map(tmp_path).edges

    assert edges.kind.tolist() == ["sonar_range", "Kante-ß"]
    assert edges.payload.tolist() == [b"\x00\x01", b""]


def test_a_save_writes_changed_tables_and_leaves_no_others(tmp_path: Path) -> None:
    save_map(full_map(), tmp_path)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "tables").iterdir()}
    map_ = load_map(tmp_path)
    states = replace(map_.vertices, velocity_mps=np.zeros((6, 3)))

    save_map(replace(map_, vertices=states), tmp_path)

    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "tables").iterdir()}
    [changed] = after.items() - before.items()
    assert changed[0].name.startswith("vertices-")
    assert len(after) == len(before) == len(TABLES)
    assert map_.digest() == full_map().digest()  # though its file is gone


def test_a_full_disk_leaves_the_old_map(tmp_path: Path) -> None:
    save_map(line_map(5), tmp_path)
    before = files_under(tmp_path)

    with (
        largest_file(20_000),
        pytest.raises(
            MapError, match=f"{tmp_path}.*too large.*the map that was there is untouched"
        ),
    ):
        save_map(line_map(200), tmp_path)

    assert files_under(tmp_path) == before
    save_map(line_map(200), tmp_path)
    assert load_map(tmp_path).digest() == line_map(200).digest()


KILLED_WRITER = """
import contextlib, hashlib, os, signal, sys, time
from pathlib import Path
import numpy as np
from mapstream.recordings.maps.history import change_map, redo, undo
from mapstream.recordings.maps.store import load_map, read_manifest, save_map
from tests.recordings.made_maps import full_map, line_map

from mapstream.streams.errors import MapError

folder, rng = Path(sys.argv[1]), np.random.default_rng(0)
old, new = full_map(), line_map(7)
steps = (
    lambda: save_map(old, folder),
    lambda: change_map(folder, "replace", lambda map_: (new, None)),
    lambda: undo(folder),
    lambda: redo(folder),
)
durations_s = {}
for step in steps * 2:  # in peace first: children need not import what a step is the first to need
    started = time.monotonic()
    step()
    durations_s[step] = time.monotonic() - started
seen = set()
# A child announces each of two steps, and their end. It dies some time after the first or the
# second announcement, however fast the machine is, and four times after the last one, at rest.
for trial, announcement in enumerate([*rng.integers(2, size=100), 2, 2, 2, 2]):
    two = [steps[(trial + k) % len(steps)] for k in range(2)]
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        for step in two:
            os.write(writing, b".")
            with contextlib.suppress(MapError):  # nothing to undo, where the one before ended
                step()
        os.write(writing, b".")
        while True:
            signal.pause()
    for _ in range(announcement + 1):
        os.read(reading, 1)
    if announcement < 2:
        time.sleep(rng.uniform(0.0, 1.2) * durations_s[two[announcement]])
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.close(reading)
    os.close(writing)
    manifest = read_manifest(folder)
    for state in manifest.states:
        for entry in state.values():
            assert hashlib.sha256((folder / entry.file).read_bytes()).hexdigest() == entry.sha256
    map_ = load_map(folder)
    operations = map_.journal.operation.tolist()
    assert (len(map_.vertices), operations) in [(6, []), (7, ["replace"])]
    seen.add((len(map_.vertices), bool(manifest.past), bool(manifest.future)))
assert seen >= {(6, False, False), (7, True, False), (6, False, True)}, seen
"""


@pytest.mark.slow
def test_S1_M19_a_killed_save_leaves_the_old_map_or_the_new_one(tmp_path: Path) -> None:
    """100 kills at random instants of saves, changes, undos and redos: map and history are whole."""
    folder = tmp_path / "map"
    command = [sys.executable, "-c", KILLED_WRITER, str(folder)]

    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)

    assert run.returncode == 0, run.stdout + run.stderr
    save_map(line_map(2), folder)
    assert len(list((folder / "tables").iterdir())) == len(
        TABLES
    )  # leftovers of the killed are gone


def test_a_map_can_be_read_while_it_is_saved(tmp_path: Path) -> None:
    maps = [line_map(4), full_map()]
    save_map(maps[0], tmp_path)

    def save_both() -> None:
        for _ in range(5):
            for map_ in maps:
                save_map(map_, tmp_path)

    writer = threading.Thread(target=save_both)
    writer.start()
    digests = set()
    while writer.is_alive():
        digests.add(load_map(tmp_path).digest())
    writer.join()

    assert digests <= {map_.digest() for map_ in maps}


def test_a_second_run_into_the_same_folder_is_refused(tmp_path: Path) -> None:
    with (
        FolderLock(tmp_path),
        pytest.raises(MapError, match=rf"{tmp_path}: another run writes.*\(process \d+\); wait"),
    ):
        save_map(line_map(2), tmp_path)

    save_map(line_map(2), tmp_path)


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match="not a map folder: No such file"):
        load_map(tmp_path / "nowhere")
    (tmp_path / "manifest.json").write_text('{"name": "an app"}')
    with pytest.raises(MapFormatError, match="expected the identifier 'mapstream map'"):
        load_map(tmp_path)


def test_another_version_is_refused(tmp_path: Path) -> None:
    save_map(line_map(2), tmp_path)
    edit_manifest(tmp_path, version=99)

    with pytest.raises(
        MapFormatError, match="format version 99, but this mapstream reads version 4"
    ):
        load_map(tmp_path)


def edit_manifest(folder: Path, **changes: object) -> None:
    file = folder / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


@pytest.mark.parametrize(
    "tables",
    [
        {},
        {"vertices": {"file": "../../etc/passwd", "sha256": "", "rows": 1}},
        {"vertices": {"file": "tables/x", "sha256": "", "rows": -1}},
    ],
)
def test_a_damaged_manifest_is_refused(tables: dict[str, object], tmp_path: Path) -> None:
    save_map(line_map(2), tmp_path)
    whole = json.loads((tmp_path / "manifest.json").read_text())["tables"]
    edit_manifest(tmp_path, tables=(whole | tables) if tables else {})

    with pytest.raises(MapFormatError, match=r"manifest\.json: damaged"):
        load_map(tmp_path)


def test_a_manifest_that_is_no_json_is_refused(tmp_path: Path) -> None:
    save_map(line_map(2), tmp_path)
    (tmp_path / "manifest.json").write_bytes(b'{"identifier": "mapstr')

    with pytest.raises(MapFormatError, match=r"manifest\.json: damaged.*restore"):
        load_map(tmp_path)


def test_damaged_tables_are_refused_by_name(tmp_path: Path) -> None:
    save_map(full_map(), tmp_path)
    [file] = (tmp_path / "tables").glob("edges-*")
    whole = file.read_bytes()
    at = len(whole) // 2

    for damaged in (whole[:-100], b"", whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]):
        file.write_bytes(damaged)
        with pytest.raises(MapFormatError, match=f"{file.name}: damaged.*restore"):
            load_map(tmp_path)
    file.unlink()
    with pytest.raises(MapFormatError, match=f"{file.name} is missing"):
        load_map(tmp_path)
    assert len(load_map(tmp_path, tables=["vertices"]).vertices) == 6
    save_map(full_map(), tmp_path)
    assert load_map(tmp_path).digest() == full_map().digest()


def test_a_map_beyond_the_limit_is_refused_before_it_is_read(tmp_path: Path) -> None:
    save_map(full_map(), tmp_path)

    with pytest.raises(
        MapFormatError, match=r"the tables have \d+ bytes, more than the limit of 9"
    ):
        load_map(tmp_path, max_bytes=9)


@pytest.mark.parametrize("name", ["edges", "vertices"])
def test_a_table_made_to_deceive_never_breaks_the_process(name: str, tmp_path: Path) -> None:
    """Whoever changes a table's bytes can also change the hash in the manifest."""
    save_map(full_map(), tmp_path)
    tables = json.loads((tmp_path / "manifest.json").read_text())["tables"]
    whole = (tmp_path / tables[name]["file"]).read_bytes()
    rng = np.random.default_rng(0)

    for _ in range(50):
        data = bytearray(whole)
        for at in rng.integers(len(data), size=3):
            data[at] = rng.integers(256)
        sha256 = hashlib.sha256(data).hexdigest()
        file = f"tables/{name}-{sha256[:16]}.arrow"
        (tmp_path / file).write_bytes(data)
        changed = tables[name] | {"file": file, "sha256": sha256}
        edit_manifest(tmp_path, tables=tables | {name: changed})
        with suppress(MapFormatError):
            load_map(tmp_path, tables=[name])


def test_a_path_that_can_be_no_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    with pytest.raises(MapError, match=f"{tmp_path}/file: cannot be used as a map folder"):
        save_map(line_map(2), tmp_path / "file")
