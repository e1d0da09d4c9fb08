"""The layout of the viewer, made from the plan: a newcomer sees the map grow, and why.

On the left the map, and below it the operators. On the right what the cameras see, the plots of the run, and
the log. What would hide the map (raw scans where deskewed ones exist, refused loops) is logged, and shown once it
is ticked in the viewer.
"""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from mapstream.graph.plan import Plan
from mapstream.graph.tap_outputs import Output
from mapstream.graph.views.run import GRAPH, graph_extent
from mapstream.recordings.maps import Map
from mapstream.streams.messages import (
    constraints,
    estimates,
    grids,
    objects,
    planes,
    sensors,
    vision,
)

_IN_SPACE = (
    sensors.LidarScan,
    sensors.OrganizedCloud,
    sensors.LaserScan2D,
    sensors.WheelOdometry,
    estimates.PointCloud,
    estimates.Odometry,
    estimates.Keyframe,
    estimates.Submap,
    estimates.LoopReport,
    estimates.MapCorrection,
    estimates.MapPose,
    constraints.Constraint,
    planes.PlaneSegments,
    grids.OccupancyGrid,
    Map,
)
_PICTURES = (sensors.CameraFrame, sensors.EncodedImage)
_OVER_PICTURES = (vision.ImageFeatures, objects.ObjectDetections)
_KNOWN = (
    *_IN_SPACE,
    *_PICTURES,
    *_OVER_PICTURES,
    sensors.ImuBatch,
    sensors.GnssFix,
    sensors.TransformBatch,
    vision.NFrame,
)
POINTS = "points"  # below the path of keypoints and objects: where they are in space
CLOSED = (rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
_HIDDEN = rrb.EntityBehavior(visible=False)


def blueprint_of(plan: Plan, outputs: Sequence[Output]) -> rrb.Blueprint:
    """Return the layout for the outputs that are drawn."""
    x_range, y_range = graph_extent(plan)
    bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    operators = rrb.GraphView(origin=GRAPH, name="Operators", visual_bounds=bounds)
    space = [output for output in outputs if output.sends(*_IN_SPACE)]
    cameras = _cameras(plan, outputs)
    features = [output.path for output in outputs if output.sends(*_OVER_PICTURES)]
    large = (
        [map_view(space, features=features)] if space else cameras
    )  # without a map the images are what there is to see
    main = rrb.Vertical(_tabs(large), operators, row_shares=[3, 1]) if large else operators
    side = [cameras if space else [], _plots(outputs), _texts(outputs)]
    shown = [_tabs(views) for views in side if views]
    return rrb.Blueprint(
        rrb.Horizontal(main, rrb.Vertical(*shown), column_shares=[5, 2]),
        rrb.TimePanel(timeline="stamp", state="collapsed"),
        *CLOSED,
    )


def _tabs(views: Sequence[rrb.View]) -> rrb.View | rrb.Tabs:
    return rrb.Tabs(*views) if len(views) > 1 else views[0]


def map_view(
    outputs: Sequence[Output] = (),
    eye: rrb.EyeControls3D | None = None,
    hidden_paths: Sequence[str] = (),
    features: Sequence[str] = (),
) -> rrb.Spatial3DView:
    """Return the view of all that has a place, seen from the map's frame; some is drawn once it is ticked.

    Of outputs with keypoints or objects, named by their paths, what is known in space is shown.
    """
    has_clouds = any(output.sends(estimates.PointCloud) for output in outputs)
    hidden = [o.path for o in outputs if o.sends(estimates.Keyframe)]
    hidden += [o.path for o in outputs if has_clouds and o.sends(sensors.LidarScan)]
    hidden += [f"{o.path}/refused" for o in outputs if o.sends(estimates.LoopReport)]
    return rrb.Spatial3DView(
        name="Map",
        origin="/",
        contents=[
            "+ /map/**",
            *(f"+ /{output.path}/**" for output in outputs),
            *(f"+ /{path}/{POINTS}/**" for path in features),
        ],
        overrides=dict.fromkeys((*hidden_paths, *(f"/{path}" for path in hidden)), _HIDDEN),
        eye_controls=eye,
        background=rrb.Background(color=0x0B0E14FF),
        line_grid=rrb.LineGrid3D(visible=True, spacing=10.0, color=0xFFFFFF10),
    )


def _cameras(plan: Plan, outputs: Sequence[Output]) -> list[rrb.View]:
    """Return a view per camera, with all features and objects that were found in its pictures.

    Objects that were recorded with the pictures are drawn over all of them.
    """
    features = [output for output in outputs if output.sends(*_OVER_PICTURES)]
    views: list[rrb.View] = []
    for picture in (output for output in outputs if output.sends(*_PICTURES)):
        source = picture.edge.from_node
        made_of_it = _made_of(plan, (source, picture.edge.from_port))
        recorded = [f.edge for f in features if f.edge.from_node == source]
        made_of_it = made_of_it.union(*(_made_of(plan, (source, e.from_port)) for e in recorded))
        found = [f for f in features if (f.edge.from_node, f.edge.from_port) in made_of_it]
        contents = [f"+ /{output.path}/**" for output in (picture, *found)]
        contents += [f"- /{output.path}/{POINTS}/**" for output in found]
        views.append(rrb.Spatial2DView(name=picture.path, origin="/", contents=contents))
    return views


def _made_of(plan: Plan, source: tuple[str, str]) -> set[tuple[str, str]]:
    """Return all outputs that are made of one output; of a stereo pair, what is made of the same side."""
    found, new = {source}, {source}
    while new:
        readers = {(e.to_node, e.to_port) for e in plan.edges if (e.from_node, e.from_port) in new}
        new = {
            (node, made)
            for node, read in readers
            for made in plan.nodes[node].signature.outputs
            if made.startswith("right_") == read.startswith("right_")
        } - found
        found |= new
    return found


def _plots(outputs: Sequence[Output]) -> list[rrb.View]:
    """Return the plots: load first, because it says which operator limits the run."""
    plots: list[rrb.View] = [
        rrb.TimeSeriesView(name=name, origin=f"/run/{entity}", plot_legend=rrb.Corner2D.LeftTop)
        for name, entity in (
            ("Load [%]", "load"),
            ("Rates [1/s]", "rates"),
            ("Queues", "queues"),
            ("Calls [ms]", "call_ms"),
            ("Losses", "losses"),
        )
    ]
    plots += [
        rrb.TimeSeriesView(name=f"{output.path} {name}", origin=f"/{output.path}/{entity}")
        for output in outputs
        if output.sends(sensors.ImuBatch)
        for name, entity in (("[rad/s]", "gyro"), ("[m/s²]", "accel"))
    ]
    plots += [
        rrb.TimeSeriesView(name=f"{output.path} keypoints", origin=f"/{output.path}")
        for output in outputs
        if output.sends(vision.NFrame)
    ]
    tracked = [output.path for output in outputs if output.sends(vision.ImageFeatures)]
    plots += [
        rrb.TimeSeriesView(name=name, origin="/", contents=[f"+ /{p}/{entity}" for p in tracked])
        for name, entity in (("Tracks", "num_tracks"), ("Track length", "mean_length"))
        if tracked
    ]
    return plots


def _texts(outputs: Sequence[Output]) -> list[rrb.View]:
    """Return the log, what nobody wrote a view for, and the fixes on the earth."""
    columns = rrb.TextLogColumns(text_log_columns=["body"])
    views: list[rrb.View] = [rrb.TextLogView(name="Log", origin="/", columns=columns)]
    views += [
        rrb.MapView(name=output.path, origin=f"/{output.path}")
        for output in outputs
        if output.sends(sensors.GnssFix)
    ]
    others = [output for output in outputs if not output.sends(*_KNOWN)]
    views += [rrb.TextDocumentView(name=o.path, origin=f"/{o.path}/summary") for o in others]
    return views
