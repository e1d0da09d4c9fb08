"""CSV files with a described header become messages, and say what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.column_files import ColumnFile
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import GnssFix, ImuBatch

POSE = "x_m,y_m,z_m,qx,qy,qz,qw"
IMU = "gyro_x_radps,gyro_y_radps,gyro_z_radps,accel_x_mps2,accel_y_mps2,accel_z_mps2"


def write(folder: Path, *lines: str) -> Path:
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    return folder / "data.csv"


def test_A9_odometry_with_velocity_biases_and_sigmas(tmp_path: Path) -> None:
    header = f"stamp_s,{POSE},vx_mps,vy_mps,vz_mps,sigma_rad,sigma_m"
    file = write(tmp_path, header, "1403715273.262142976,1,2,3,0,0,0,1,4,5,6,0.1,0.2")

    ((topic, message),) = ColumnFile(file).messages()

    assert topic == "/odometry"
    assert isinstance(message, Odometry)
    assert message.stamp_ns == 1403715273262142976
    np.testing.assert_array_equal(message.T_odom_base.t, [1, 2, 3])
    assert message.velocity_mps is not None
    np.testing.assert_array_equal(message.velocity_mps, [4, 5, 6])
    assert message.gyro_bias_radps is None
    assert message.covariance is not None
    np.testing.assert_allclose(np.diagonal(message.covariance), [0.01] * 3 + [0.04] * 3)


def test_rows_of_several_kinds_leave_the_cells_of_others_empty(tmp_path: Path) -> None:
    file = write(
        tmp_path,
        f"stamp_ms,{IMU},latitude_deg,longitude_deg,altitude_m,position_x_m,position_y_m,position_z_m,position_sigma_m",
        "1,1,2,3,4,5,6,,,,,,,",
        "2,1,2,3,4,5,6,49.0,8.4,110,,,,",
        "# a remark",
        "3,,,,,,,,,,1,2,3,0.5",
    )

    messages = list(ColumnFile(file).messages())

    assert [topic for topic, _ in messages] == ["/imu", "/imu", "/gnss", "/position"]
    imu, _, fix, position = (message for _, message in messages)
    assert isinstance(imu, ImuBatch)
    assert (imu.stamp_ns, imu.accel_mps2[0].tolist()) == (1_000_000, [4, 5, 6])
    assert isinstance(fix, GnssFix)
    assert (fix.latitude_deg, fix.covariance_enu_m2) == (49.0, None)
    assert isinstance(position, Constraint)
    assert np.diagonal(position.covariance).tolist() == [np.inf] * 3 + [0.25] * 3


def test_A24_csv_becomes_a_recording_with_its_topics(tmp_path: Path) -> None:
    rows = [f"{i},1,2,3,4,5,6" for i in range(1, 26)]
    file = write(tmp_path, f"stamp_us,{IMU},colour", *(f"{row},red" for row in rows))

    done = convert(f"csv:{file}", tmp_path / "out.mcap")

    with open_recording(done.path) as recording:
        decode = decoder_for(recording.topics["/imu"].channel, ImuBatch)
        batches = [decode(raw) for raw in recording.messages()]
    stamps_ns = np.concatenate([batch.stamps_ns for batch in batches])  # type: ignore[attr-defined]  # ImuBatch
    assert stamps_ns.tolist() == [1000 * i for i in range(1, 26)]
    assert done.notices == ("columns that mean nothing here were left out: colour",)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (("time,x_m",), r"csv:1: expected a header with one of stamp_ns.*found time, x_m"),
        (("stamp_s,foo",), r"csv:1: the header describes no measurement; known columns are imu:"),
        (("stamp_s,x_m,y_m,z_m",), r"csv:1: odometry needs the columns qx, qy, qz, qw as well"),
        ((f"stamp_s,{POSE}", "1,2"), r"csv:2: expected 8 cells, found 2"),
        ((f"stamp_s,{POSE}", "1,a,0,0,0,0,0,1"), r"csv:2: x_m: expected a number, found 'a'"),
        ((f"stamp_s,{POSE}", "1,inf,0,0,0,0,0,1"), r"csv:2: x_m: expected a finite number"),
        ((f"stamp_s,{POSE}", "1,,0,0,0,0,0,1"), r"csv:2: x_m: expected a number, found ''"),
        ((f"stamp_s,{POSE}", "1,0,0,0,0,0,0,0"), r"csv:2: .*quaternion"),
        ((f"stamp_s,{POSE}", *["1,0,0,0,0,0,0,1"] * 2), r"csv:3: stamps must increase"),
        ((f"stamp_s,{POSE}", "x,0,0,0,0,0,0,1"), r"csv:2: "),
        ((f"stamp_s,{POSE}",), r"expected rows of measurements below the header"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(
    lines: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    file = write(tmp_path, *lines)

    with pytest.raises(RecordingError, match=message):
        convert(f"csv:{file}", tmp_path / "out.mcap")
