"""EuRoC sequences as MCAP, in the ASL layout and as single files."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.attached_rig import rig_of
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import ConfigError, RecordingError
from mapstream.streams.messages.sensors import EncodedImage
from mapstream.streams.sensors import CameraSensor, ImuSensor
from tests.data import shared
from tests.recordings.made_datasets import EUROC_CAMERA, EUROC_IMU

IMU = "#timestamp [ns],w_RS_S_x [rad s^-1],...\n1403715273262142976,1,2,3,4,5,6\n1403715273267142976,1,2,3,4,5,7\n"
TRUTH = "#timestamp,...\n1403715273262142976,1,2,3,1,0,0,0,4,5,6,.1,.2,.3,.4,.5,.6\n"


def decoded(path: Path, topic: str) -> list[Any]:
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        return [decode(message) for message in recording.messages([topic])]


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    files = {
        "imu0/data.csv": IMU,
        "imu0/sensor.yaml": EUROC_IMU,
        "state_groundtruth_estimate0/data.csv": TRUTH,
        "cam0/data.csv": "#timestamp [ns],filename\n1403715273262142976,a.png\n",
        "cam0/sensor.yaml": EUROC_CAMERA,
        "cam0/data/a.png": "not looked into",
    }
    for name, content in files.items():
        path = tmp_path / "V1" / "mav0" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return tmp_path / "V1"


def test_A24_euroc_imu_truth_and_images(sequence: Path, tmp_path: Path) -> None:
    done = convert(f"euroc:{sequence}", tmp_path / "out.mcap")

    (imu,) = decoded(done.path, "/imu")
    assert imu.stamps_ns.tolist() == [1403715273262142976, 1403715273267142976]
    np.testing.assert_array_equal(imu.gyro_radps[0], [1, 2, 3])
    np.testing.assert_array_equal(imu.accel_mps2[1], [4, 5, 7])
    (truth,) = decoded(done.path, "/truth")
    np.testing.assert_array_equal(truth.T_odom_base.R, np.eye(3))
    np.testing.assert_array_equal(truth.T_odom_base.t, [1, 2, 3])
    np.testing.assert_array_equal(truth.velocity_mps, [4, 5, 6])
    np.testing.assert_array_equal(truth.gyro_bias_radps, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(truth.accel_bias_mps2, [0.4, 0.5, 0.6])
    (image,) = decoded(done.path, "/cam0/image")
    assert isinstance(image, EncodedImage)
    assert (image.format, image.frame, image.data.tobytes()) == ("png", "cam0", b"not looked into")
    assert done.notices == ()


def test_A24_euroc_sensors_are_attached(sequence: Path, tmp_path: Path) -> None:
    rig = rig_of(convert(f"euroc:{sequence}", tmp_path / "out.mcap").path)

    imu, camera = rig.select("imu"), rig.select("camera")
    assert isinstance(imu, ImuSensor)
    assert imu.noise is not None
    assert imu.noise.accel_density == 2e-3
    assert isinstance(camera, CameraSensor)
    np.testing.assert_array_equal(camera.calibration.focal_px, [458.654, 457.296])  # type: ignore[union-attr]  # no LiDAR
    T_base_camera = rig.transforms.look_up(rig.base_frame, "cam0", 0)
    np.testing.assert_array_equal(T_base_camera.t, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("imu0/data.csv", "#\n1,2,3\n", RecordingError, r"data\.csv: expected rows of numbers"),
        ("imu0/data.csv", f"{IMU}5,1,2,3,4,5,6\n", RecordingError, "row 3: stamps must increase"),
        ("imu0/data.csv", "#\n1,nan,2,3,4,5,6\n", RecordingError, "row 1: expected finite"),
        ("cam0/data.csv", "1,b.png\n", RecordingError, r"data\.csv:1: expected a stamp and a file"),
        ("cam0/sensor.yaml", EUROC_CAMERA.replace("pinhole", "omni"), ConfigError, "got omni"),
        ("cam0/sensor.yaml", EUROC_CAMERA.replace("[0, -1", "[0, -2"), ConfigError, "T_BS"),
    ],
)
def test_damaged_sequences_are_refused(
    sequence: Path, name: str, content: str, error: type[Exception], message: str, tmp_path: Path
) -> None:
    (sequence / "mav0" / name).write_text(content)

    with pytest.raises(error, match=message):
        convert(f"euroc:{sequence}", tmp_path / "out.mcap")


def test_a_folder_of_something_else_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")

    with pytest.raises(RecordingError, match=r"expected mav0/imu0/data\.csv.*found notes\.txt"):
        convert(f"euroc:{tmp_path}", tmp_path / "out.mcap")


def test_A24_euroc_real_single_files(tmp_path: Path) -> None:
    """The beginning of V1_02; the truth of the camera is not that of the body."""
    (tmp_path / "V1_02").mkdir()
    for path in shared("euroc_v102_imu").iterdir():
        with path.open() as lines:
            (tmp_path / "V1_02" / path.name).write_text("".join(islice(lines, 1001)))

    done = convert(f"euroc:{tmp_path / 'V1_02'}", tmp_path / "out.mcap")

    assert sum(len(b.stamps_ns) for b in decoded(done.path, "/imu")) == 1000
    np.testing.assert_array_equal(
        decoded(done.path, "/truth")[0].T_odom_base.t, [0.515356, 1.996773, 0.971104]
    )
    assert done.notices == ("no sensor.yaml of the IMU: places and noise are not known",)


@pytest.mark.slow
def test_A24_euroc_real_sequence(tmp_path: Path) -> None:
    done = convert(f"euroc:{shared('euroc_v101_stereo_imu')}", tmp_path / "v101.mcap")

    assert sum(len(b.stamps_ns) for b in decoded(done.path, "/imu")) == 29120
    assert len(decoded(done.path, "/cam1/image")) == 20
    assert decoded(done.path, "/truth")[0].accel_bias_mps2 is not None
