import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.sources.imu_files import read_imu, sensor_names
from fusecap.sources.imu_files.track import unwrapped
from session_files import imu_csv


def rotations(count, seed=3):
    return Rotation.random(count, random_state=seed)


def wxyz(rotation):
    return rotation.as_quat()[:, [3, 0, 1, 2]]


def angle_deg(first_wxyz, second_wxyz):
    first = Rotation.from_quat(first_wxyz[:, [1, 2, 3, 0]])
    return np.degrees((first.inv() * Rotation.from_quat(second_wxyz[:, [1, 2, 3, 0]])).magnitude())


def gravity_in_imu_world(track):
    world_from_imu = Rotation.from_quat(track.orientation_wxyz[:, [1, 2, 3, 0]])
    return world_from_imu.apply(track.accel_m_s2).mean(axis=0)


@pytest.fixture
def csv(tmp_path):
    path = tmp_path / "imu.csv"

    def make(change=lambda rows: rows, count=20):
        text = imu_csv(np.arange(count) / 50, wxyz(rotations(count)))
        header, *rows = text.strip().split("\n")
        path.write_text("\n".join([header, *change(rows)]) + "\n")
        return path

    return make


def test_csv_reads_back(csv):
    track = read_imu(csv(), format="csv")
    assert track.notes == () and track.rate_hz == pytest.approx(50)
    assert angle_deg(track.orientation_wxyz, wxyz(rotations(20))).max() < 1e-4
    assert np.allclose(gravity_in_imu_world(track), [0, 0, 9.80665], atol=1e-6)


def test_lost_packets_are_counted(csv):
    track = read_imu(csv(lambda rows: rows[:5] + rows[8:12] + rows[13:]), format="csv")
    assert track.gaps[track.gaps > 0].tolist() == [3, 1]
    assert len(track.times_s) == 16


def test_out_of_order_samples_are_sorted(csv):
    track = read_imu(csv(lambda rows: [rows[1], rows[0], *rows[2:]]), format="csv")
    assert track.notes == ("1 samples out of order, sorted",)
    assert angle_deg(track.orientation_wxyz, wxyz(rotations(20))).max() < 1e-4


def test_of_duplicate_timestamps_the_first_is_kept(csv):
    def repeat(rows):
        other = rows[3].split(",")[:1] + rows[9].split(",")[1:]
        return [*rows[:4], ",".join(other), *rows[4:]]

    track = read_imu(csv(repeat), format="csv")
    assert track.notes == ("1 duplicate timestamps dropped",)
    assert angle_deg(track.orientation_wxyz, wxyz(rotations(20))).max() < 1e-4


def test_unusable_rows_are_dropped_and_counted(csv):
    def damage(rows):
        rows[2] = "nan," + rows[2].split(",", 1)[1]
        rows[4] = rows[4].split(",", 1)[0] + ",nan,0,0,0,0,0,9.8"
        rows[6] = rows[6].split(",", 1)[0] + ",0,0,0,0,0,0,9.8"
        rows[-1] = rows[-1][:12]
        return rows

    track = read_imu(csv(damage), format="csv")
    assert "3 rows without time or orientation dropped" in track.notes
    assert "1 zero quaternions dropped" in track.notes
    assert len(track.times_s) == 16


def test_quaternions_are_normalised(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text(imu_csv(np.arange(5) / 50, 2 * wxyz(rotations(5)), np.zeros((5, 3))))
    track = read_imu(path, format="csv")
    assert track.notes == ("5 quaternions were not unit",)
    assert np.allclose(np.linalg.norm(track.orientation_wxyz, axis=1), 1)


def test_accelerations_beyond_every_scale_are_missing(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text("time_s,qw,qx,qy,qz,ax,ay,az\n0,1,0,0,0,1e39,0,0\n0.01,1,0,0,0,0,9.8,0\n")
    accel = read_imu(path, format="csv").accel_m_s2
    assert np.isnan(accel[0]).all() and np.allclose(accel[1], [0, 9.8, 0])


def test_acceleration_may_be_left_out(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text("time_s,qw,qx,qy,qz\n0,1,0,0,0\n0.01,1,0,0,0\n")
    assert np.isnan(read_imu(path, format="csv").accel_m_s2).all()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "no header line"),
        ("time_s,qw,qx,qy\n0,1,0,0\n", "no column 'qz'"),
        ("time_s,qw,qx,qy,qz\n", "no samples"),
        ("time_s,qw,qx,qy,qz\n0,nan,0,0,0\n", "no sample with an orientation"),
        ("\x00\x01", "no header line"),
    ],
)
def test_unusable_csv_is_refused(tmp_path, content, expected):
    path = tmp_path / "imu.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=expected) as caught:
        read_imu(path, format="csv")
    assert "imu.csv" in str(caught.value)


def test_missing_file_and_unknown_format_are_refused(tmp_path, csv):
    with pytest.raises(InputError, match="no such file"):
        read_imu(tmp_path / "nothing.csv", format="csv")
    with pytest.raises(InputError, match="'xsens-mt'"):
        read_imu(csv(), format="xsens-mtw")


XSENS = {
    "quaternion": (["Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"], wxyz),
    "matrix": (
        [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)],
        lambda rotation: rotation.as_matrix().transpose(0, 2, 1).reshape(-1, 9),
    ),
    "euler": (
        ["Roll", "Pitch", "Yaw"],
        lambda rotation: rotation.as_euler("ZYX", degrees=True)[:, ::-1],
    ),
}


def xsens_text(kind, counters, delimiter="\t", rate="// Update Rate: 100.0Hz\n"):
    names, convert = XSENS[kind]
    rotation = rotations(len(counters))
    force = rotation.inv().apply(np.tile([0, 0, 9.8], (len(counters), 1)))
    rows = np.column_stack([force, convert(rotation)])
    lines = [delimiter.join(["PacketCounter", "SampleTimeFine", "Acc_X", "Acc_Y", "Acc_Z", *names])]
    for counter, row in zip(counters, rows, strict=True):
        lines.append(delimiter.join([f"{counter:05d}", "", *(f"{value:.9f}" for value in row)]))
    return rate + "\r\n".join(lines) + "\r\n"


@pytest.mark.parametrize("kind", XSENS)
@pytest.mark.parametrize("delimiter", ["\t", ","])
def test_every_xsens_variant_gives_the_same_orientation(tmp_path, kind, delimiter):
    path = tmp_path / "mt.txt"
    path.write_text(xsens_text(kind, np.arange(30), delimiter))
    track = read_imu(path, format="xsens-mt")
    assert angle_deg(track.orientation_wxyz, wxyz(rotations(30))).max() < 1e-4
    assert np.allclose(gravity_in_imu_world(track), [0, 0, 9.8], atol=1e-6)


def test_packet_counter_wraps_at_65536(tmp_path):
    counters = np.mod(np.arange(65530, 65545), 65536)
    path = tmp_path / "mt.txt"
    path.write_text(xsens_text("quaternion", np.delete(counters, [7, 8])))
    track = read_imu(path, format="xsens-mt")
    assert track.gaps[track.gaps > 0].tolist() == [2]
    assert track.times_s[-1] == pytest.approx(0.14)
    assert track.clock is not None and track.clock.start_s == pytest.approx(655.30)


def test_xsens_export_without_rate_asks_for_it(tmp_path):
    path = tmp_path / "mt.txt"
    path.write_text(xsens_text("quaternion", np.arange(5), rate="// \n"))
    with pytest.raises(InputError, match="rate_hz"):
        read_imu(path, format="xsens-mt")
    assert read_imu(path, format="xsens-mt", rate_hz=60).rate_hz == pytest.approx(60)


def test_broken_matrices_are_dropped(tmp_path):
    lines = xsens_text("matrix", np.arange(5)).splitlines()
    lines[4] = "\t".join(["00002", "", "0", "0", "9.8", *["0"] * 9])
    lines[5] = "\t".join(["00003", "", "0", "0", "9.8", *["nan"] * 9])
    path = tmp_path / "mt.txt"
    path.write_text("\n".join(lines))
    assert len(read_imu(path, format="xsens-mt").times_s) == 3


@given(st.integers(0, 65535), st.lists(st.integers(1, 30000), min_size=1, max_size=20))
def test_unwrapping_undoes_the_wrap(start, steps):
    true = start + np.concatenate([[0], np.cumsum(steps)])
    assert np.array_equal(unwrapped(np.mod(true, 65536).astype(float), 65536), true)


MVNX = """<?xml version="1.0"?>
<mvnx xmlns="http://www.xsens.com/mvn/mvnx" version="4"><subject frameRate="60">
<sensors><sensor label="Pelvis"/><sensor label="T8"/></sensors><frames>
<frame time="0" type="tpose"><orientation>1 0 0 0</orientation></frame>
<frame time="0" index="0" type="normal">
<sensorOrientation>1 0 0 0 0.5 0.5 0.5 0.5</sensorOrientation>
<sensorFreeAcceleration>0 0 0 1 2 3</sensorFreeAcceleration></frame>
<frame time="17" index="1" type="normal">
<sensorOrientation>1 0 0 0 0.5 0.5 0.5</sensorOrientation></frame>
</frames></subject></mvnx>"""


def test_mvnx_free_acceleration_becomes_specific_force(tmp_path):
    path = tmp_path / "a.mvnx"
    path.write_text(MVNX)
    assert sensor_names(path, "mvnx") == ("Pelvis", "T8")
    track = read_imu(path, format="mvnx", sensor="T8")
    assert np.allclose(gravity_in_imu_world(track), [1, 2, 3 + 9.80665])
    assert track.notes == ("1 rows without time or orientation dropped",)
    with pytest.raises(InputError, match="Pelvis, T8"):
        read_imu(path, format="mvnx")
    with pytest.raises(InputError, match="'Pelvis'"):
        read_imu(path, format="mvnx", sensor="Pelvs")


def test_mvnx_with_entities_or_cut_off_is_refused(tmp_path):
    path = tmp_path / "a.mvnx"
    path.write_text(MVNX[: len(MVNX) // 2])
    with pytest.raises(InputError, match="truncated"):
        read_imu(path, format="mvnx", sensor="T8")
    bomb = '<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>\n<mvnx'
    path.write_text(MVNX.replace("<mvnx", bomb, 1))
    with pytest.raises(InputError, match="DOCTYPE"):
        read_imu(path, format="mvnx", sensor="T8")


STO = (
    "DataRate=100\nDataType=Quaternion\nversion=3\nOpenSimVersion=4.1\nendheader\n"
    "time\tpelvis_imu\ttorso_imu\n0\t1,0,0,0\t0,1,0,0\n0.01\t1,0,0,0\t0,0,1,0\n0.02\t1,0\n"
)


def test_sto_columns_are_sensors(tmp_path):
    path = tmp_path / "a.sto"
    path.write_text(STO)
    assert sensor_names(path, "sto") == ("pelvis_imu", "torso_imu")
    track = read_imu(path, format="sto", sensor="torso_imu")
    assert np.array_equal(track.orientation_wxyz, [[0, 1, 0, 0], [0, 0, 1, 0]])
    for broken in (STO.replace("endheader", ""), STO.replace("Quaternion", "double"), STO[:70]):
        path.write_text(broken)
        with pytest.raises(InputError):
            read_imu(path, format="sto", sensor="torso_imu")


WALK = "opensense_xsens_mtw/mtw_txt_8imu_walking/MT_012005D6_009-001_00B42{}.txt"


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("serial", "column"),
    [
        ("279", "pelvis_imu"), ("268", "torso_imu"), ("27C", "femur_r_imu"),
        ("1EE", "femur_l_imu"), ("27D", "tibia_r_imu"), ("1ED", "tibia_l_imu"),
        ("1EF", "calcn_r_imu"), ("1E6", "calcn_l_imu"),
    ],
)  # fmt: skip
def test_matrix_export_equals_the_same_trial_as_sto(data_dir, serial, column):
    matrix = read_imu(data_dir / WALK.format(serial), format="xsens-mt")
    sto = read_imu(
        data_dir / "opensense_xsens_mtw/opensim_models_imu_tutorial/walking_orientations.sto",
        format="sto",
        sensor=column,
    )
    count = min(len(matrix.times_s), len(sto.times_s))
    assert count > 2400
    difference = angle_deg(matrix.orientation_wxyz[:count], sto.orientation_wxyz[:count])
    assert difference.max() < 1e-3
    assert matrix.notes == () and sto.notes == ()


GRAVITY = [
    (WALK.format("279"), "xsens-mt", None),
    ("opensense_xsens_mtw/opensim_core_tests/MT_012005D6_031-000_00B421AF.txt", "xsens-mt", None),
    ("opensense_xsens_mtw/opensim_core_tests/MT_01200312-002-000_00B474BA.txt", "xsens-mt", None),
    (
        "opensense_xsens_mtw/opensim_core_tests/MT2022_ACC_GYRO_ROT_EULER_TAB_00B42D4F.txt",
        "xsens-mt",
        None,
    ),
    (
        "opensense_xsens_mtw/opensim_core_tests/MT2022_ACC_GYRO_ROT_MAT_COMMA_00B42D4B.txt",
        "xsens-mt",
        None,
    ),
    ("opensense_xsens_mtw/dot_csv/Pelvis_20210820_202113_836.csv", "xsens-dot", None),
    ("opensense_xsens_mtw/opensim_core_tests/apdm_imuData01.csv", "apdm-csv", "Upper"),
    ("opensense_xsens_mtw/opensim_core_tests/apdm_imuData01.csv", "apdm-csv", "Lower"),
    ("xsens_mvnx/Meri-020_mvnx_v3_4frames.mvnx", "mvnx", "LeftHand"),
    ("xsens_mvnx/test_mocap_mvnx_v4_upperbody.mvnx", "mvnx", "Pelvis"),
    ("gait_imu_vicon/imu/S02-Trial-Walk-1-L_Foot.csv", "gaittoolbox-csv", None),
]


@pytest.mark.real_data
@pytest.mark.parametrize(("path", "format", "sensor"), GRAVITY)
def test_specific_force_averages_to_gravity_upwards(data_dir, path, format, sensor):
    track = read_imu(data_dir / path, format=format, sensor=sensor, rate_hz=100)
    assert np.allclose(gravity_in_imu_world(track), [0, 0, 9.8], atol=0.3)


@pytest.mark.real_data
def test_export_without_orientation_is_refused(data_dir):
    with pytest.raises(InputError, match="no orientation"):
        read_imu(
            data_dir / "opensense_xsens_mtw/opensim_core_tests/MT2022_ACC_00B42D4B.txt",
            format="xsens-mt",
            rate_hz=100,
        )


@pytest.mark.real_data
def test_half_lost_dot_recording_says_so(data_dir):
    track = read_imu(
        data_dir / "opensense_xsens_mtw/dot_csv/LFemur_20210820_202113_831.csv", format="xsens-dot"
    )
    assert track.gaps.sum() > 10


def test_moments_by_iso_8601_are_times(tmp_path):
    path = tmp_path / "thigh.csv"
    path.write_text(
        "time_iso,qw,qx,qy,qz,ax,ay,az\n"
        "2026-11-28T23:59:59.990Z,1,0,0,0,0,0,9.81\n"
        "2026-11-29 01:00:00.000+01:00,1,0,0,0,0,0,9.81\n"
        "2026-11-29T00:00:00.010,1,0,0,0,0,0,9.81\n"
    )
    track = read_imu(path, format="csv")
    assert np.allclose(track.times_s, [0.0, 0.01, 0.02], atol=1e-6)
