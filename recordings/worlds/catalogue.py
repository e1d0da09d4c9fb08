"""Synthetic worlds by name, and how to write one to a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.mcap_whole import whole_mcap
from mapstream.recordings.worlds.mr_config import WMrConfig
from mapstream.recordings.worlds.simulation import Simulation
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.recordings.worlds.w_lid import WLidConfig, w_lid
from mapstream.recordings.worlds.w_mr import w_mr
from mapstream.recordings.worlds.w_pan import WPanConfig, w_pan
from mapstream.recordings.worlds.w_rgbd import WRgbdConfig, w_rgbd
from mapstream.recordings.worlds.w_vi import WViConfig, w_vi
from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True)
class World:
    """One kind of synthetic recording."""

    summary: str
    config_type: type[BaseModel]
    simulate: Callable[[Any, int], Simulation]  # of a config of that type, and a seed


WORLDS = {
    "w_lid": World("a loop of corridors, LiDAR, IMU, drifting odometry", WLidConfig, w_lid),
    "w_2d": World("an office, planar laser, wheels that slip, the plan", W2dConfig, w_2d),
    "w_rgbd": World("a room with a table, colour and depth camera, IMU", WRgbdConfig, w_rgbd),
    "w_mr": World("a building, robots of four kinds and eleven ways", WMrConfig, w_mr),
    "w_vi": World("a hall, five cameras, IMU, drifting odometry, GPS and tags", WViConfig, w_vi),
    "w_pan": World("a room, a depth camera that pans and tilts, /tf", WPanConfig, w_pan),
}


def simulate(
    name: str,
    path: str | Path,
    *,
    seed: int = 0,
    on_progress: Callable[[float], None] | None = None,
    **options: Any,  # noqa: ANN401  # the world's config checks them
) -> Path:
    """Write a synthetic recording as MCAP; the same name, seed and options give the same bytes.

    The file is there whole or not at all.

    Args:
        name: A key of `WORLDS`.
        path: The file to write; one that exists is replaced.
        seed: Of everything random in the world.
        on_progress: Called with the fraction done, once a message.
        options: Fields of the world's config.

    Raises:
        ConfigError: If there is no such world or option.
        RecordingError: If the file cannot be written.
    """
    if name not in WORLDS:
        raise ConfigError(f"no world {name!r}; there are {', '.join(sorted(WORLDS))}")
    world = WORLDS[name]
    try:
        config = world.config_type.model_validate(options)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        known = ", ".join(world.config_type.model_fields)
        raise ConfigError(f"{name}.{key}: {first['msg']}; options are {known}") from error
    simulation = world.simulate(config, seed)
    span_ns = simulation.end_ns - simulation.start_ns
    with whole_mcap(path) as writer:
        if simulation.rig is not None:
            attach_rig(writer, simulation.rig)
        for record in simulation.records:
            writer.write(record.topic, record.message, record.log_ns)
            if on_progress is not None:
                on_progress(min(1.0, (record.log_ns - simulation.start_ns) / span_ns))
    return Path(path)
