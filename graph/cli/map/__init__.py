"""`mapstream map DIR COMMAND`: the offline tools for maps, a module per group of verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.map.certainty import align, covariance, reject_outliers
from mapstream.graph.cli.map.dense import add_verbs as add_dense_verbs
from mapstream.graph.cli.map.edit import anchor, edit
from mapstream.graph.cli.map.files import export_, import_
from mapstream.graph.cli.map.grid import grid
from mapstream.graph.cli.map.history import journal, redo, undo
from mapstream.graph.cli.map.landmarks import add_verbs, optimize_visual
from mapstream.graph.cli.map.look import check, cloud_quality, picture, stats, view
from mapstream.graph.cli.map.loops import close_loops, fix_stationary, loops
from mapstream.graph.cli.map.moving import remove_moving_
from mapstream.graph.cli.map.naming import label, unlabel, where
from mapstream.graph.cli.map.parts import merge, remove
from mapstream.graph.cli.map.places import summarize
from mapstream.graph.cli.map.regions import region
from mapstream.graph.cli.map.registration import find_places, register
from mapstream.graph.cli.map.solve import optimize, relax
from mapstream.graph.cli.map.surveys import elevation_, tiles

_WITH_POINTS = {"ignore_unknown_options": True}  # -1,0,0 is no option
app = typer.Typer(
    help="Work on a map: `mapstream map DIR COMMAND`.", no_args_is_help=True, rich_markup_mode=None
)


@app.callback()
def _folder(context: typer.Context, folder: Annotated[Path, typer.Argument(metavar="DIR")]) -> None:
    """Work on the map in a folder."""
    context.obj = folder


app.command("check")(check)
app.command("stats")(stats)
app.command("cloud-quality")(cloud_quality)
app.command("view")(view)
app.command("picture")(picture)
app.command("journal")(journal)
app.command("undo")(undo)
app.command("redo")(redo)
app.command("import")(import_)
app.command("export")(export_)
app.command("remove-moving")(remove_moving_)
app.command("tiles")(tiles)
app.command("elevation")(elevation_)
app.command("elevation_mapping", hidden=True)(elevation_)
app.command("optimize")(optimize)
app.command("optvi", hidden=True)(optimize)
app.command("optimize-visual")(optimize_visual)
app.command("optv", hidden=True)(optimize_visual)
app.command("relax")(relax)
app.command("reject-outliers")(reject_outliers)
app.command("align")(align)
app.command("covariance")(covariance)
app.command("close-loops")(close_loops)
app.add_typer(loops, name="loops")
app.command("register")(register)
app.command("find-places")(find_places)
app.command("admc", hidden=True)(register)
app.command("fix-stationary")(fix_stationary)
app.command("anchor")(anchor)
app.add_typer(edit, name="edit")
app.command("remove")(remove)
app.command("merge")(merge)
app.command("label", context_settings=_WITH_POINTS)(label)
app.command("unlabel", context_settings=_WITH_POINTS)(unlabel)
app.command("where")(where)
app.add_typer(region, name="region")
app.command("grid")(grid)
app.command("summarize")(summarize)
app.command("clsm", hidden=True)(summarize)
add_verbs(app)
add_dense_verbs(app)
