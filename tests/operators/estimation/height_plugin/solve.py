"""Two poses that odometry links but for their heights; the barometer knows those."""

import numpy as np

from mapstream.operators.estimation.batch import optimize_map
from mapstream.recordings.maps.build import add_edges, append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap

MISSION = "0f" * 16
stamps = (1_000, 2_000)
keyframes = tuple(
    Keyframe(stamp_ns=s, odometry=Odometry(stamp_ns=s, T_odom_base=SE3.identity())) for s in stamps
)
planar = RelativePose(
    kind="wheel",
    mission_a=MISSION,
    stamp_a_ns=stamps[0],
    mission_b=MISSION,
    stamp_b_ns=stamps[1],
    T_a_b=SE3.identity(),
    covariance=np.diag([1e-4] * 5 + [np.inf]),
)
map_ = append_submap(
    Map.empty(), Submap(mission_id=MISSION, index=0, keyframes=keyframes, edges=())
)
map_ = add_edges(map_, [planar])
rows = map_.vertex_rows(MISSION, list(stamps))  # poses at times
barometer = Edges(
    kind=np.array(["height_difference"], dtype=object),
    vertex_a=rows[:1],
    vertex_b=rows[1:],
    covariance=np.diag([np.inf] * 5 + [1e-4])[None],
    payload=np.array([b'{"up_m": 3.0}'], dtype=object),
)
solved, report = optimize_map(append_edges(map_, barometer))
count = report.num_edges["height_difference"]
print(f"height_difference:{count}", solved.vertices.T_mission_base[1, 2, 3])  # noqa: T201
