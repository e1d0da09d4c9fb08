"""Maps of a million rows: factors from tables, and saving and loading, against the libraries below alone."""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.table import Row, markdown
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.recordings.maps import Map, load_map, save_map
from mapstream.recordings.maps.build import new_mission
from mapstream.recordings.maps.history import change_map
from mapstream.recordings.maps.ids import id_array
from mapstream.recordings.maps.model import vertex_ids
from mapstream.recordings.maps.tables import Edges, Landmarks, Observations, Vertices
from mapstream.streams.geometry import se3_exp

NUM_FACTORS, AT_ONCE = 1_000_000, 100_000  # made in stretches, as memory is that of a laptop
NUM_OBSERVATIONS, NUM_LANDMARKS, NUM_VERTICES = 1_000_000, 100_000, 10_000
ROUNDS = 3
MISSION = "ab" * 16


def _chain(num_vertices: int, rng: np.random.Generator) -> Map:
    """Return a mission with odometry between neighbours, each with a covariance of its own."""
    stamps_ns = np.arange(num_vertices, dtype=np.int64)
    poses = se3_exp(rng.normal(size=(num_vertices, 6)))
    vertices = Vertices(
        id=vertex_ids(MISSION, stamps_ns),
        mission=np.zeros(num_vertices, dtype=np.int64),
        stamp_ns=stamps_ns,
        T_mission_base=poses,
    )
    num_edges = num_vertices - 1
    roots = rng.normal(size=(num_edges, 6, 6))
    edges = Edges(
        id=rng.integers(0, 256, (num_edges, 16)).astype(np.uint8),
        kind=np.full(num_edges, "odometry", dtype=object),
        vertex_a=np.arange(num_edges),
        vertex_b=np.arange(num_edges) + 1,
        T_a_b=se3_exp(rng.normal(size=(num_edges, 6))),
        covariance=roots @ np.swapaxes(roots, 1, 2) + np.eye(6),
    )
    return replace(new_mission(Map.empty(), MISSION), vertices=vertices, edges=edges)


def _bare_factors(edges: Edges) -> list[object]:
    """Make the same factors with gtsam alone, in a plain loop."""
    ends = zip(edges.vertex_a.tolist(), edges.vertex_b.tolist(), strict=True)
    made: list[object] = []
    for (a, b), T_a_b, covariance in zip(ends, edges.T_a_b, edges.covariance, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        made.append(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T_a_b), noise))
    return made


def _factors() -> tuple[float, float]:
    """Return the seconds that a million factors take, ours and with gtsam alone."""
    map_ = _chain(AT_ONCE + 1, np.random.default_rng(0))
    rows = np.arange(AT_ONCE)
    ours_s = bare_s = 0.0
    for _ in range(NUM_FACTORS // AT_ONCE):  # in turn, so that both see the same machine
        ours_s += _seconds(lambda: make_factors(map_, rows, NoiseModels()))
        bare_s += _seconds(lambda: _bare_factors(map_.edges))
    return ours_s, bare_s


def _seen(rng: np.random.Generator) -> Map:
    map_ = _chain(NUM_VERTICES, rng)
    landmarks = Landmarks(
        id=id_array(number.to_bytes(16, "big") for number in range(NUM_LANDMARKS)),
        kind=np.full(NUM_LANDMARKS, "visual", dtype=object),
        vertex=rng.integers(0, NUM_VERTICES, NUM_LANDMARKS),
        p_base=rng.normal(size=(NUM_LANDMARKS, 3)),
    )
    observations = Observations(
        vertex=rng.integers(0, NUM_VERTICES, NUM_OBSERVATIONS),
        landmark=rng.integers(0, NUM_LANDMARKS, NUM_OBSERVATIONS),
        sensor=np.full(NUM_OBSERVATIONS, "camera", dtype=object),
        keypoint_px=rng.uniform(0, 1000, (NUM_OBSERVATIONS, 2)).astype(np.float32),
    )
    return replace(map_, landmarks=landmarks, observations=observations)


def _files(folder: Path) -> tuple[dict[str, float], int]:
    """Return seconds of saving, saving a change, loading, and of the bare bytes; and how many bytes."""
    map_ = _seen(np.random.default_rng(1))
    best: dict[str, float] = {}

    def measure(name: str, work: Callable[[], object]) -> None:
        best[name] = min(best.get(name, np.inf), _seconds(work))

    for round_ in range(ROUNDS):
        target, raw = folder / str(round_), folder / f"raw{round_}"
        measure("save", partial(save_map, map_, target))
        data = b"".join(path.read_bytes() for path in sorted((target / "tables").iterdir()))
        measure("write", partial(_write, raw, data))
        measure("load", partial(_load, target))
        measure("read", partial(_read, raw))
        measure("check", partial(_read_and_check, raw))
    poses = replace(map_.vertices, T_mission_base=map_.vertices.T_mission_base.copy())
    measure("change", partial(save_map, replace(map_, vertices=poses), folder / "0"))
    measure("journal", partial(change_map, folder / "0", "touch", lambda same: (same, None)))
    return best, sum(path.stat().st_size for path in (folder / "0" / "tables").iterdir())


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _load(folder: Path) -> None:
    """Load a map, and read every page of its observations, which it maps from their file."""
    seen = load_map(folder).observations
    for values in (seen.vertex, seen.landmark, seen.offset_ns, seen.keypoint_px, seen.p_sensor):
        values.sum()


def _read(file: Path) -> None:
    np.fromfile(file, np.uint8).max()


def _read_and_check(file: Path) -> None:
    hashlib.sha256(np.fromfile(file, np.uint8).data).hexdigest()


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def run() -> list[Row]:
    """Measure a million factors, and a map of a million observations."""
    ours_s, bare_s = _factors()
    with tempfile.TemporaryDirectory() as folder:
        took_s, num_bytes = _files(Path(folder))
    size = f"{num_bytes / 1e6:.0f} MB"
    save_s, write_s, load_s, read_s = (took_s[name] for name in ("save", "write", "load", "read"))
    change_s, journal_s, check_s = (took_s[name] for name in ("change", "journal", "check"))
    return [
        Row(what="1e6 factors from tables", ours=f"{ours_s:.1f} s", other=f"gtsam in a loop {bare_s:.1f} s", ratio=ours_s / bare_s, bar="at most 1.5"),
        Row(what=f"save 1e6 observations, {size}", ours=f"{save_s:.2f} s", other=f"the same bytes alone {write_s:.2f} s", ratio=save_s / write_s),
        Row(what="load them", ours=f"{load_s:.2f} s", other=f"numpy, the same bytes {read_s:.2f} s", ratio=load_s / read_s),
        Row(what="load them", ours=f"{load_s:.2f} s", other=f"numpy and SHA-256 {check_s:.2f} s", ratio=load_s / check_s),
        Row(what="save again, poses changed", ours=f"{change_s:.2f} s", other=f"the first save {save_s:.2f} s", ratio=change_s / save_s),
        Row(what="a change with checks and undo", ours=f"{journal_s:.2f} s", other=f"the first save {save_s:.2f} s", ratio=journal_s / save_s),
    ]  # fmt: skip


if __name__ == "__main__":
    print(markdown(run()))
