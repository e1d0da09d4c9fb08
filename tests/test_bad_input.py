"""Bad recordings, bad graphs, bad luck: what a user of the command line sees, and what is saved all the same."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.folder import LOCK, FolderLock
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import load_map
from mapstream.recordings.mcap_writer import McapWriter
from tests.bad_recordings import Points, drive, flip, record, record_clouds, truncate
from tests.data import shared
from tests.full_disk import largest_file
from tests.graph.terminal import Done, Terminal
from tests.recordings.made_maps import files_under

NUM_SCANS = len(drive())
HOUR_NS = 3600 * 10**9
PRESET = Path(__file__).parents[1] / "graph" / "presets" / "lidar.yaml"
INLINE = [
    word
    for name in ("sensors", "odometry", "loops", "optimizer", "store", "trajectory")
    for word in ("--set", f"{name}.run=inline")
]
# Every scan becomes a vertex, so that vertices tell what of the recording is in the map.
EVERY_SCAN = [*INLINE, "--set", "keyframes.distance_m=0.001", "--set", "loops.links=[]"]


@pytest.fixture
def mapstream(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Done]:
    """The command line in a folder of its own; whatever happens, nobody sees a traceback."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAPSTREAM_TRACEBACK", raising=False)
    terminal = Terminal(capsys)

    def run(*words: object) -> Done:
        done = terminal(*words)
        assert "Traceback" not in done.out + done.err
        assert "a mistake of its own" not in done.err
        return done

    return run


@pytest.fixture
def run(mapstream: Callable[..., Done]) -> Callable[..., Done]:
    """Map a recording with the preset `lidar`, every scan a vertex."""
    return lambda file, *more: mapstream("run", "lidar", file, "--map", "m", *EVERY_SCAN, *more)


def saved() -> Map:
    map_ = load_map("m")
    assert check_map(map_, Path("m")) == []
    return map_


class TestDamagedFiles:
    @pytest.mark.slow
    def test_truncated(self, run: Callable[..., Done], mapstream: Callable[..., Done]) -> None:
        file = truncate(record(Path("drive.mcap")))
        readable = mapstream("info", file, "--json").json["num_messages"]

        done = run(file)

        assert done.code == 3
        assert "lidar: finished with loss" in done.out
        assert re.search(r"drive\.mcap at byte \d+: .*the file ends inside", done.err)
        assert "an unknown number of messages lost" in done.err
        assert NUM_SCANS // 3 < len(saved().vertices) == readable < NUM_SCANS

    def test_flipped_byte(self, run: Callable[..., Done]) -> None:
        file = record(Path("drive.mcap"))
        offset = flip(file, chunk=3)

        done = run(file)

        assert done.code == 3
        loss = (
            f"drive.mcap at byte {offset}: /points: chunk: its CRC does not match; 2 messages lost"
        )
        assert loss in done.err
        assert len(saved().vertices) == NUM_SCANS - 2

    def test_every_chunk_damaged(self, run: Callable[..., Done]) -> None:
        file = record(Path("drive.mcap"))
        for chunk in range(NUM_SCANS // 2):
            flip(file, chunk)

        done = run(file)

        assert done.code == 1
        assert f"drive.mcap: nothing can be read: all {NUM_SCANS // 2} chunks asked for" in done.err
        assert not Path("m").exists()

    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (b"", "the file is empty"),
            (b"\x89MCAP0\r\n", "no message can be read: at byte 8"),
            (b"x,y,z\n1,2,3\n", "no message can be read: at byte 0"),
        ],
    )
    def test_no_recording_at_all(
        self, mapstream: Callable[..., Done], content: bytes, reason: str
    ) -> None:
        file = Path("drive.mcap")
        file.write_bytes(content)

        for words in (("run", "lidar", file, "--map", "m"), ("info", file), ("doctor", file)):
            done = mapstream(*words)
            assert done.code == 1
            assert done.err.startswith(f"drive.mcap: {reason}")

    def test_folder_of_no_recording_or_of_two(self, mapstream: Callable[..., Done]) -> None:
        Path("day").mkdir()
        none = mapstream("info", "day")
        for name in ("a.mcap", "b.mcap"):
            record(Path("day", name), drive()[:1])
        two = mapstream("info", "day")

        assert (none.code, two.code) == (1, 1)
        assert none.err.startswith("day: a folder with neither metadata.yaml nor an .mcap file")
        assert two.err.startswith("day: a folder with 2 .mcap files; give one recording")

    def test_recording_without_messages(self, mapstream: Callable[..., Done]) -> None:
        with McapWriter("drive.mcap"):
            pass

        done = mapstream("run", "lidar", "drive.mcap", "--map", "m")

        assert done.code == 2
        assert "no topic '/points', and none of type LidarScan; there is no message" in done.err
        assert "there is no message in it" in mapstream("doctor", "drive.mcap").out


class TestUnknownMessages:
    @pytest.mark.parametrize(
        ("channel", "reason"),
        [
            (
                {"schema": ""},
                "no decoder for a channel without a schema in cdr; known: sensor_msgs",
            ),
            ({"schema": "my_msgs/msg/Thing"}, "no decoder for schema 'my_msgs/Thing' in cdr"),
            ({"encoding": "cbor"}, "message encoding 'cbor' is not known; known: cdr, ros1"),
        ],
    )
    def test_no_decoder(
        self, mapstream: Callable[..., Done], channel: dict[str, str], reason: str
    ) -> None:
        file = record_clouds(Path("drive.mcap"), **channel)  # type: ignore[arg-type]

        done = mapstream("run", "lidar", file, "--map", "m")

        assert done.code == 2
        assert re.match(
            r".*lidar\.yaml:\d+:\d+: operators\.sensors\.config\.topics\.scans: ", done.err
        )
        assert f"drive.mcap: /points: {reason}" in done.err
        assert reason in mapstream("doctor", file).out
        assert "not decoded" in mapstream("info", file).out

    def test_fields_that_are_missing_everywhere(self, run: Callable[..., Done]) -> None:
        file = record_clouds(Path("drive.mcap"), lambda _, points: without_xyz(points))

        done = run(file)

        assert done.code == 1
        assert "/points: messages that cannot be decoded; the first is sensor_msgs" in done.err
        assert f"no point field x, y, z; there are: a, b, c, t ({NUM_SCANS} times)" in done.err
        assert re.search(r"lidar\.yaml:\d+:3: operator 'store' .* no map came", done.err)
        assert "wrote" not in done.out

    def test_fields_that_are_missing_at_first(self, run: Callable[..., Done]) -> None:
        file = record_clouds(
            Path("drive.mcap"), lambda i, points: without_xyz(points) if i < 4 else points
        )

        done = run(file)

        assert done.code == 3
        assert re.search(r"drive\.mcap: /points: messages .* log time \d+ .*\(4 times\)", done.err)
        assert len(saved().vertices) == NUM_SCANS - 4


def without_xyz(points: Points) -> Points:
    """Return points whose coordinates have other names."""
    layout = [("a", "<f4"), ("b", "<f4"), ("c", "<f4"), ("t", "<u4")]
    return points.view(np.dtype(layout))


class TestStamps:
    def test_one_that_runs_backwards(self, run: Callable[..., Done]) -> None:
        file = record_clouds(
            Path("drive.mcap"), stamp=lambda i, ns: ns - 150_000_000 if i == 10 else ns
        )

        done = run(file)

        assert done.code == 3
        at_ns = drive()[10].stamp_ns
        text = f"drive.mcap: /points: stamps run backwards, first at log time {at_ns} ns"
        assert text in done.out
        assert "1 messages came later than the edge allows" in done.err
        assert len(saved().vertices) == NUM_SCANS - 1

    @pytest.mark.parametrize(("jump_ns", "way"), [(-HOUR_NS, "backward"), (HOUR_NS, "forward")])
    def test_a_clock_that_jumps(self, run: Callable[..., Done], jump_ns: int, way: str) -> None:
        file = record_clouds(
            Path("drive.mcap"), stamp=lambda i, ns: ns + jump_ns if i >= 12 else ns
        )

        done = run(file)

        assert done.code == 0, done.err
        at_ns = drive()[12].stamp_ns
        text = f"drive.mcap: /points: its clock jumps {way}, first at log time {at_ns} ns"
        assert text in done.out
        map_ = saved()
        assert [len(map_.vertices_of(row)) for row in range(2)] == [12, NUM_SCANS - 12]
        assert len(re.findall(r"wrote m-[0-9a-f]{8}\.tum", done.out)) == 2

    def test_one_for_all(self, run: Callable[..., Done]) -> None:
        file = record_clouds(Path("drive.mcap"), stamp=lambda *_: drive()[0].stamp_ns)

        done = run(file)

        assert done.code == 3
        assert "/points: stamps repeat, first at log time" in done.out
        assert "moments whose stamp does not increase" in done.err
        assert len(saved().vertices) >= 1

    def test_none(self, run: Callable[..., Done]) -> None:
        file = record_clouds(Path("drive.mcap"), stamp=lambda *_: 0)

        done = run(file)

        assert done.code == 0, done.err
        assert "/points: stamps of zero, the log time is used, first at log time" in done.out
        assert len(saved().vertices) == NUM_SCANS


class TestClouds:
    def test_points_that_are_not_finite(self, run: Callable[..., Done]) -> None:
        file = record_clouds(Path("drive.mcap"), lambda _, points: poked(points))

        done = run(file)

        assert done.code == 0, done.err
        count = sum(len(scan.points[::7]) for scan in drive())
        assert f"drive.mcap: /points: points that are not finite ({count} times)" in done.out
        assert len(saved().vertices) == NUM_SCANS

    @pytest.mark.parametrize("size", [0, 1])
    def test_some_of_no_point_or_one(self, run: Callable[..., Done], size: int) -> None:
        file = record_clouds(
            Path("drive.mcap"), lambda i, points: points[:size] if i in (0, 5, 6) else points
        )

        done = run(file)

        assert done.code == 0, done.err
        lost = drive()[5].stamp_ns
        assert f"odometry: scan at {lost} ns could not be registered: {size} points" in done.out
        bridged = "warning: submaps: a step that no sensor measured is bridged by the motion model"
        assert bridged in done.out  # and the operator's name stands there once
        assert len(saved().vertices) == NUM_SCANS - 1  # nobody knows where the first one was

    @pytest.mark.parametrize("size", [0, 1])
    def test_all_of_no_point_or_one(self, run: Callable[..., Done], size: int) -> None:
        done = run(record_clouds(Path("drive.mcap"), lambda _, points: points[:size]))

        assert done.code == 1
        reason = f"the odometry was lost at each of {NUM_SCANS} moments, so there is nothing to map"
        assert reason in done.err
        assert "wrote" not in done.out
        assert not Path("m/manifest.json").exists()

    def test_points_of_one_time(
        self, run: Callable[..., Done], mapstream: Callable[..., Done]
    ) -> None:
        file = record_clouds(Path("drive.mcap"), lambda _, points: at_once(points))

        done = run(file)

        assert done.code == 0, done.err
        assert "drive.mcap: /points: scans whose points all have one time, not deskewed" in done.out
        assert "give all points one time" in mapstream("doctor", file).out
        assert len(saved().vertices) == NUM_SCANS


def poked(points: Points) -> Points:
    points = points.copy()
    points["x"][::7] = np.nan
    points["y"][::14] = np.inf
    return points


def at_once(points: Points) -> Points:
    points = points.copy()
    points["t"] = 12345
    return points


class TestGraphs:
    """The preset `lidar` with one mistake: told with the line, before anything runs."""

    @pytest.mark.parametrize(
        ("right", "wrong", "message"),
        [
            (
                "use: kiss_odometry",
                "use: kis_odometry",
                "operators.odometry.use: no operator 'kis_odometry'; did you mean 'kiss_odometry'?",
            ),
            (
                "scans: sensors.scans",
                "scans: sensors.scan",
                "operators.odometry.in.scans: sensors (mcap) has no output 'scan'; did you mean 'scans'?",
            ),
            (
                "in: {scans: sensors.scans}",
                "in: {scan: sensors.scans}",
                "operators.odometry.in.scan: kiss_odometry has no input 'scan'; did you mean 'scans'?",
            ),
            (
                "keyframes: keyframes.keyframes",
                "keyframes: odometry.odometry",
                "odometry.odometry sends Odometry, but submaps.keyframes takes Keyframe",
            ),
            ("from: optimizer.corrections, feedback: true", "from: optimizer.corrections", "cycle"),
        ],
    )
    def test_mistake(
        self, mapstream: Callable[..., Done], right: str, wrong: str, message: str
    ) -> None:
        text = PRESET.read_text()
        line = text[: text.index(right)].count("\n") + 1
        Path("mine.yaml").write_text(text.replace(right, wrong))
        file = record(Path("drive.mcap"))

        for words in (("run", "mine.yaml", file, "--map", "m"), ("check", "mine.yaml", file)):
            done = mapstream(*words)
            assert done.code == 2
            assert message in done.err
            assert f"mine.yaml:{line}:" in done.err
        assert not Path("m").exists()

    @pytest.mark.slow
    def test_topic_of_another_name(self, mapstream: Callable[..., Done]) -> None:
        """A preset takes the only LiDAR and says so; a graph of one's own is not second-guessed."""
        file = record(Path("drive.mcap"), topic="/velodyne")
        Path("mine.yaml").write_text(PRESET.read_text())

        preset = mapstream("run", "lidar", file, "--map", "m", *EVERY_SCAN)
        own = mapstream("run", "mine.yaml", file, "--map", "n", *EVERY_SCAN)
        told = ("--param", "scans_topic=/velodyne")
        own_told = mapstream("run", "mine.yaml", file, "--map", "n", *EVERY_SCAN, *told)

        assert preset.code == 0
        assert "reading /velodyne (mapstream.LidarScan); there is no /points" in preset.err
        assert own.code == 2
        assert re.match(r"mine\.yaml:\d+:\d+: operators\.sensors\.config\.topics\.scans: ", own.err)
        assert "drive.mcap has no topic '/points'; there is /velodyne" in own.err
        assert own_told.code == 0

    def test_topic_of_another_name_in_a_real_recording(
        self, mapstream: Callable[..., Done]
    ) -> None:
        file = shared("kitti_camera_lidar") / "kitti_camera_lidar.mcap"

        done = mapstream("check", "lidar", file)

        assert done.code == 0
        assert "reading /velodyne_points (sensor_msgs/msg/PointCloud2)" in done.err


class TestBrokenOperators:
    @pytest.fixture(autouse=True)
    def _plugin(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Install the operator `breaks`, as pip would."""
        folder = tmp_path / "site" / "breaks-1.0.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: breaks\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(
            "[mapstream.operators]\nbreaks = tests.bad_operators:Breaks\n"
        )
        monkeypatch.syspath_prepend(tmp_path / "site")

    @pytest.mark.parametrize(
        ("how", "place", "reason"),
        [
            ("raise", "process", "ZeroDivisionError: division by zero"),
            ("die", "process", "SIGKILL"),
        ],
    )
    @pytest.mark.slow
    def test_breaks_after_eight_scans(
        self, mapstream: Callable[..., Done], how: str, place: str, reason: str
    ) -> None:
        operator = f"  breaks: {{use: breaks, in: {{scans: sensors.scans}}, run: {place}, config: {{how: {how}}}}}\n"
        text = PRESET.read_text().replace("in: {scans: sensors.scans}", "in: {scans: breaks.scans}")
        Path("mine.yaml").write_text(text + operator)
        line = text.count("\n") + 1

        done = mapstream("run", "mine.yaml", record(Path("drive.mcap")), "--map", "m", *EVERY_SCAN)

        assert done.code == 1
        at_ns = drive()[8].stamp_ns
        where = (
            f"mine.yaml:{line}:3: operator 'breaks' (breaks) failed after scans at stamp_ns {at_ns}"
        )
        assert where in done.err
        assert reason in done.err
        assert "wrote m\n" in done.out
        assert len(saved().vertices) == 8


@pytest.mark.slow
class TestMapFolders:
    def test_second_run_into_a_map(self, run: Callable[..., Done]) -> None:
        file = record(Path("drive.mcap"))
        run(file)
        before = files()

        done = run(file)

        assert done.code == 1
        assert re.search(r"lidar\.yaml:\d+:3: operator 'store'", done.err)
        assert "m: there is a map already; choose another folder, or replace it" in done.err
        assert "wrote" not in done.out
        assert files() == before
        assert run(file, "--set", "store.on_existing=replace").code == 0

    def test_second_run_beside_one_that_writes(self, run: Callable[..., Done]) -> None:
        with FolderLock(Path("m")):
            done = run(record(Path("drive.mcap")))

        assert done.code == 1
        assert re.search(r"m: another run writes into this map folder \(process \d+\)", done.err)
        assert "wrote" not in done.out

    @pytest.mark.parametrize("num_bytes", [4_000, 300])  # clouds do not fit, nothing fits
    def test_full_disk_leaves_the_old_map(self, run: Callable[..., Done], num_bytes: int) -> None:
        run(record(Path("drive.mcap")))
        before = files()
        other = record_clouds(Path("other.mcap"), stamp=lambda _, ns: ns + HOUR_NS)

        with largest_file(num_bytes):
            done = run(other, "--set", "store.on_existing=replace")

        assert done.code == 1
        assert re.search(
            r"operator 'store' .* m/clouds/\S+: the cloud could not be written", done.err
        )
        assert "wrote m\n" not in done.out
        assert files() == before
        assert len(saved().vertices) == NUM_SCANS


def files() -> dict[str, bytes]:
    """Return what lies in the map's folder, but for the lock, which names the last process."""
    found = files_under(Path("m"))
    del found[LOCK]
    return found


@pytest.mark.slow
def test_the_installed_command_on_a_truncated_recording(tmp_path: Path) -> None:
    """All of it once as a user has it: processes of their own, a pipe for a terminal, an exit code."""
    file = truncate(record(tmp_path / "drive.mcap"))

    done = subprocess.run(  # our own program
        [
            sys.executable,
            "-m",
            "mapstream.graph.cli",
            "run",
            "lidar",
            file,
            "--map",
            tmp_path / "m",
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )

    assert done.returncode == 3
    assert "Traceback" not in done.stdout + done.stderr
    assert "drive.mcap at byte" in done.stderr
    assert check_map(load_map(tmp_path / "m"), tmp_path / "m") == []
