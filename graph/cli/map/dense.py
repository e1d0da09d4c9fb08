"""Verbs of dense maps: meshes, volumes, distance fields, depth, images; maplab's names do the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, complain, fraction_bar, in_place, say, say_json
from mapstream.operators.dense.fusion import FusionReport
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.history import change_map

ConfigT = TypeVar("ConfigT", bound=OperatorConfig)
ReportT = TypeVar("ReportT")
VoxelOption = Annotated[
    float | None, typer.Option("--voxel-size-m", min=0.001, help="Edge of a voxel.")
]
UnanchoredFlag = Annotated[
    bool, typer.Option("--with-unanchored", help="Also missions whose place is a guess.")
]


def mesh(  # one for each option of the command
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The mesh: .ply or .glb.")],
    *,
    voxel_size_m: VoxelOption = None,
    with_unanchored: UnanchoredFlag = False,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Fuse depth images or clouds where the poses of now put them, and write the surface with its colours."""
    from mapstream.operators.dense.mesh import MeshConfig, make_mesh  # noqa: PLC0415

    folder: Path = context.obj
    config = config_from(MeshConfig, _sets(voxel_size_m, set_, with_unanchored=with_unanchored))
    with fraction_bar("fusing") as show:
        report = make_mesh(load_map(folder), folder, file, config, show)
    if json:
        say_json(report)
        return
    _tell(report.fused)
    say(f"wrote {in_place(file)}: {report.num_vertices} vertices, {report.num_faces} triangles")


def tsdf(  # one for each option of the command
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The volume: .npz.")],
    *,
    voxel_size_m: VoxelOption = None,
    with_unanchored: UnanchoredFlag = False,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Fuse depth images or clouds into truncated signed distances, and write the blocks of voxels."""
    from mapstream.operators.dense.fusion import FusionConfig, fuse  # noqa: PLC0415
    from mapstream.operators.dense.volume_files import save_volume  # noqa: PLC0415

    folder: Path = context.obj
    config = config_from(FusionConfig, _sets(voxel_size_m, set_, with_unanchored=with_unanchored))
    with fraction_bar("fusing") as show:
        volume, report = fuse(load_map(folder), folder, config, on_progress=show)
    save_volume(file, volume)
    if json:
        say_json(report)
        return
    _tell(report)
    say(f"wrote {in_place(file)}")


def esdf(  # noqa: PLR0913  # one for each option of the command
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The distances and states of voxels: .npz.")],
    *,
    voxel_size_m: VoxelOption = None,
    with_unanchored: UnanchoredFlag = False,
    picture: Annotated[Path | None, typer.Option(help="A slice as .png.")] = None,
    at_z_m: Annotated[float, typer.Option(help="The height of the slice in the map.")] = 0.0,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write how far it is to the nearest surface from anywhere, and what is free, occupied or unknown."""
    from mapstream.operators.dense.distance_field import (  # noqa: PLC0415
        FieldConfig,
        field_of_map,
        save_field,
        write_picture,
    )

    folder: Path = context.obj
    config = config_from(FieldConfig, _sets(voxel_size_m, set_, with_unanchored=with_unanchored))
    with fraction_bar("fusing") as show:
        field, report = field_of_map(load_map(folder), folder, config, show)
    save_field(file, field)
    if picture is not None:
        write_picture(picture, field, at_z_m)
    if json:
        say_json(report)
        return
    _tell(report.fused)
    counts = ", ".join(f"{count} {state}" for state, count in report.num_voxels.items())
    say(f"wrote {in_place(file)}: {counts} voxels")
    if picture is not None:
        say(f"wrote {in_place(picture)}")


def stereo_depth(
    context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False
) -> None:
    """Compute depth images of the stereo pairs that the vertices refer to; they become part of the map."""
    from mapstream.operators.dense import stereo_depth as tool  # noqa: PLC0415

    folder: Path = context.obj
    config = config_from(tool.StereoDepthConfig, set_)
    report = _changed(folder, "stereo-depth", tool.stereo_depth, config)
    if json:
        say_json(report)
        return
    if report.num_incomplete:
        complain(f"left out: {report.num_incomplete} vertices without both images")
    share = f"{100 * report.mean_share:.0f} % of the pixels have a depth"
    say(f"{in_place(folder)}: {report.num_images} depth images, {share}")


def depth_clouds(
    context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False
) -> None:
    """Make clouds of depth images; they become part of the map."""
    from mapstream.operators.dense import depth_clouds as tool  # noqa: PLC0415

    folder: Path = context.obj
    config = config_from(tool.DepthCloudsConfig, set_)
    report = _changed(folder, "depth-clouds", tool.depth_clouds, config)
    if json:
        say_json(report)
        return
    _tell_left_out(report.left_out)
    kept = f", {report.num_kept} vertices had one" if report.num_kept else ""
    say(f"{in_place(folder)}: {report.num_clouds} clouds of {report.num_points} points{kept}")


def export_images(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to write.")],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write the images behind the vertices with the poses of their cameras; form=pmvs: as PMVS wants them."""
    from mapstream.operators.dense import image_export as tool  # noqa: PLC0415

    folder: Path = context.obj
    config = config_from(tool.ImageExportConfig, set_)
    with fraction_bar("writing") as show:
        report = tool.export_images(load_map(folder), out, config, show)
    if json:
        say_json(report)
        return
    counts = ", ".join(f"{count} of {name}" for name, count in report.num_images.items())
    say(f"wrote {in_place(out)}: images, {counts}")


def export_for_pmvs(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to write.")],
    *,
    json: JsonFlag = False,
) -> None:
    """Write images without distortion and projections as PMVS wants them."""
    export_images(context, out, set_=["form=pmvs"], json=json)


def _changed(
    folder: Path,
    operation: str,
    tool: Callable[[Map, Path, ConfigT, Callable[[float], None]], tuple[Map, ReportT]],
    config: ConfigT,
) -> ReportT:
    """Let a tool change the map, with a bar on a terminal, and return its report."""
    settings = config.model_dump(mode="json", exclude_defaults=True)
    with fraction_bar(operation) as show:
        return change_map(
            folder, operation, lambda map_: tool(map_, folder, config, show), **settings
        )


def _sets(
    voxel_size_m: float | None, sets: list[str] | None, *, with_unanchored: bool
) -> list[str]:
    """Return options as `--set` takes them."""
    found = [] if voxel_size_m is None else [f"voxel_size_m={voxel_size_m}"]
    return [*found, *(["with_unanchored=true"] if with_unanchored else []), *(sets or [])]


def _tell(report: FusionReport) -> None:
    _tell_left_out(report.left_out)
    what = "depth images" if report.source == "depth" else "clouds"
    size = f"{report.num_blocks} blocks of voxels, {report.num_bytes / 1e6:.0f} MB"
    say(f"fused {report.num_views} {what}: {size}")


def _tell_left_out(left_out: dict[str, int]) -> None:
    for reason, count in left_out.items():
        complain(f"left out: {count} {reason}")


def add_verbs(app: typer.Typer) -> None:
    """Add the verbs, and maplab's names of them, which help does not list."""
    named: dict[str, tuple[Callable[..., None], str]] = {
        "mesh": (mesh, "export_tsdf"),
        "tsdf": (tsdf, ""),
        "esdf": (esdf, ""),
        "stereo-depth": (stereo_depth, "sdr"),
        "depth-clouds": (depth_clouds, "convert_all_depth_maps_to_point_clouds"),
        "export-images": (export_images, "export_timestamped_images"),
    }
    for name, (verb, alias) in named.items():
        app.command(name)(verb)
        if alias:
            app.command(alias, hidden=True)(verb)
    app.command("stereo_dense_reconstruction", hidden=True)(stereo_depth)
    app.command("export_for_pmvs", hidden=True)(export_for_pmvs)
