"""World W-MR: three kinds of robots in one building, and a fourth that has nearly all they have."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heappop, heappush, merge

from mapstream.recordings.worlds.mr_config import WMrConfig
from mapstream.recordings.worlds.mr_rig import ROBOTS, mr_rig
from mapstream.recordings.worlds.mr_sensors import MrSensors
from mapstream.recordings.worlds.simulation import Record, Simulation


def w_mr(config: WMrConfig, seed: int) -> Simulation:
    """Return the recording of one robot; equal arguments give equal recordings.

    Topics, of what it has: `/front_left/image`, `/front_right/image`; `/color/image`, `/depth/image` (16UC1 [mm], of the
    same pixels); `/imu`, `/points`, `/wheels`, `/gnss`; `/odometry` (drifts); `/front_left/objects` or `/color/objects`.
    `/truth` is the pose of the base in the building, `/truth/objects` what was detected, `/truth/things` where what is.
    """
    robot, sensors = ROBOTS[config.robot], MrSensors(config, seed)
    streams = [sensors.truth(), sensors.things(), sensors.odometry()]
    streams += [sensors.inertial()] if robot.has_imu else []
    streams += [sensors.wheels()] if robot.has_wheels else []
    streams += [sensors.scans()] if robot.has_lidar else []
    streams += [sensors.fixes()] if robot.has_satellites else []
    streams += [sensors.images()] if robot.has_cameras else []
    streams += [sensors.depths()] if robot.has_rgbd else []
    streams += [sensors.objects(config.objects)] if config.objects and robot.has_sight else []
    late_ns = {topic: round(delay_s * 1e9) for topic, delay_s in config.delays_s.items()}
    return Simulation(
        start_ns=sensors.span_ns[0],
        end_ns=sensors.span_ns[1],
        rig=mr_rig(robot, f"{config.robot}{config.number}", config.imu, sensors.calibrations),
        records=_delayed(merge(*streams, key=lambda record: record.log_ns), late_ns),
    )


def _delayed(records: Iterator[Record], late_ns: dict[str, int]) -> Iterator[Record]:
    """Yield records in the order in which they become known, those of some topics later than at first."""
    waiting: list[tuple[int, int, Record]] = []
    for number, each in enumerate(records):
        while waiting and waiting[0][0] <= each.log_ns:
            yield heappop(waiting)[2]
        log_ns = each.log_ns + late_ns.get(each.topic, 0)
        heappush(waiting, (log_ns, number, Record(log_ns, each.topic, each.message)))
    while waiting:
        yield heappop(waiting)[2]
