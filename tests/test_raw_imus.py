"""Sensors that recorded rates and accelerations, and no orientation."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.doctor import diagnose
from fusecap.errors import InputError, SessionError
from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.imu_files.loader import imu_format_of, read_imu
from fusecap.sources.session_file import load_session
from fusecap.sources.session_sensors import mount, open_imus
from fusecap.types import GRAVITY_M_S2

RATE_HZ = 100.0
TIMES_S = np.arange(0, 20, 1 / RATE_HZ)
NORTH_IN_WORLD = np.array([0.0, 20.0, -40.0])


def tumbling():
    """A sensor that rests, and then turns about all axes without moving; its rates, exactly."""
    moving = np.clip(TIMES_S - 3, 0, None)[:, None]
    angles = np.concatenate([0.8 * np.sin(moving), 0.6 * moving, 0.5 * np.sin(1.7 * moving)], 1)
    world_from_imu = Rotation.from_euler("zyx", angles)
    ahead = (world_from_imu[:-1].inv() * world_from_imu[1:]).as_rotvec() * RATE_HZ
    return world_from_imu, np.concatenate([ahead[:1], ahead])


def written(path, header, gyro_unit_rad_s=1.0, *, magnetic=False, first=None, skip=None):
    world_from_imu, gyro = tumbling()
    force = world_from_imu.inv().apply([0, 0, GRAVITY_M_S2])
    names = [f"{what}_{axis}" for what in ("Acc", "Gyr") for axis in "XYZ"]
    columns = [force, gyro / gyro_unit_rad_s]
    if magnetic:
        names += [f"Mag_{axis}" for axis in "XYZ"]
        columns.append(world_from_imu.inv().apply(NORTH_IN_WORLD))
    time = TIMES_S[:, None] if first is None else first
    rows = np.delete(np.concatenate([time, *columns], axis=1), skip or [], axis=0)
    lines = [",".join([header, *names]), *(",".join(f"{v:.6f}" for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def away_deg(track, *, heading):
    """Angle of up, and with `heading` of the whole orientation."""
    kept = np.round(track.times_s * RATE_HZ).astype(int)
    error = from_wxyz(track.orientation_wxyz) * tumbling()[0][kept].inv()
    if heading:
        return np.degrees(error.magnitude())
    return np.degrees(np.arccos(np.clip(error.apply([0, 0, 1])[:, 2], -1, 1)))


@pytest.mark.parametrize("magnetic", [False, True])
def test_up_is_found_and_with_a_magnetometer_north(tmp_path, magnetic):
    path = written(tmp_path / "a.csv", "time_s", magnetic=magnetic, skip=[500, 501, 900])
    track = read_imu(path, format="csv")
    assert len(track.times_s) == len(TIMES_S) - 3
    assert away_deg(track, heading=magnetic)[300:].max() < 3.0
    assert ("heading is arbitrary" in " ".join(track.notes)) is not magnetic
    assert np.isfinite(track.accel_m_s2).all()


def test_a_static_trial_of_unknown_heading_says_nothing_of_the_motion(tmp_path):
    for name in ("a.csv", "b.csv"):
        written(tmp_path / name, "time_s")
    text = '[session]\nname = "s"\n\n[[subject]]\nname = "anna"\ntpose_s = [0, 2]\n'
    text += '\n[[subject.imu]]\nbone = "hips"\nfile = "a.csv"\nheading_deg = 40\n'
    (tmp_path / "session.toml").write_text(text)
    (anna,) = load_session(tmp_path).subjects
    assert len(mount(anna, open_imus(anna))) == 1
    (tmp_path / "session.toml").write_text(text + 'static_file = "b.csv"\n')
    (anna,) = load_session(tmp_path).subjects
    with pytest.raises(SessionError, match="static_file and file face different ways"):
        mount(anna, open_imus(anna))


def test_each_format_has_its_units_and_is_known_by_its_columns(tmp_path):
    count = np.arange(len(TIMES_S), dtype=float)[:, None]
    dot = written(
        tmp_path / "dot.csv",
        "PacketCounter,SampleTimeFine",
        np.pi / 180,
        first=np.concatenate([count, 1e4 * count], axis=1),
    )
    mt = written(tmp_path / "mt.txt", "PacketCounter", first=count)
    plain = written(tmp_path / "plain.csv", "time_s")
    for path, format in ((dot, "xsens-dot"), (mt, "xsens-mt"), (plain, "csv")):
        assert imu_format_of(path) == format
        assert away_deg(read_imu(path, format=format, rate_hz=RATE_HZ), heading=False).max() < 3.0


def test_without_the_library_its_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "vqf", None)
    with pytest.raises(InputError, match="accelerometer needs a library") as refused:
        read_imu(written(tmp_path / "a.csv", "time_s"), format="csv")
    assert "'vqf>=" in str(refused.value)


def test_a_hole_and_a_glimpse_are_refused(tmp_path):
    hole = written(tmp_path / "a.csv", "time_s", skip=list(range(600, 800)))
    with pytest.raises(InputError, match=r"2\.0 s without samples.*cut"):
        read_imu(hole, format="csv")
    glimpse = written(tmp_path / "b.csv", "time_s", skip=list(range(50, len(TIMES_S))))
    with pytest.raises(InputError, match="too short"):
        read_imu(glimpse, format="csv")


@pytest.mark.real_data
@pytest.mark.parametrize("segment", ["lower_back", "foot_left", "lower_leg_right"])
def test_a_walker_is_upright_by_raw_sensors(data_dir, tmp_path, segment):
    from scipy.io import loadmat

    recording = loadmat(data_dir / "full_body_imu/full_body_example_data.mat", simplify_cells=True)
    sensor = recording[segment]
    path = tmp_path / "sensor.csv"
    names = [f"{what}_{axis}" for what in ("Acc", "Gyr") for axis in "XYZ"]
    np.savetxt(
        path,
        np.concatenate([recording["t"][:, None], sensor["acc"], sensor["gyr"]], axis=1),
        delimiter=",",
        header="time_s," + ",".join(names),
        comments="",
    )
    track = read_imu(path, format="csv")
    mean = from_wxyz(track.orientation_wxyz).apply(track.accel_m_s2).mean(axis=0)
    assert np.hypot(*mean[:2]) < 0.1 and mean[2] == pytest.approx(GRAVITY_M_S2, rel=0.05)


@pytest.mark.parametrize(("written_in", "told"), [(np.pi / 180, "deg/s"), (180 / np.pi, "rad/s")])
def test_rates_of_another_unit_are_refused_by_its_name(tmp_path, written_in, told):
    header, first = "time_s", None
    if told == "rad/s":  # a DOT's are degrees
        count = np.arange(len(TIMES_S), dtype=float)[:, None]
        header, first = "PacketCounter,SampleTimeFine", np.hstack([count, 1e4 * count])
        written_in = 1.0
    path = written(tmp_path / "a.csv", header, written_in, first=first)
    with pytest.raises(InputError, match=f"gyroscope is in {told}"):
        read_imu(path, format=imu_format_of(path))


def test_a_sensor_that_faces_nobody_knows_where_is_an_error_until_that_is_found(tmp_path):
    written(tmp_path / "hips.csv", "time_s")
    text = (
        '[session]\nname = "raw"\n[[subject]]\nname = "A"\n[[subject.imu]]\nbone = "hips"\n'
        'file = "hips.csv"\nbone_from_imu_wxyz = [1, 0, 0, 0]\n'
    )
    (tmp_path / "session.toml").write_text(text)
    errors = [f for f in diagnose(tmp_path) if f.severity == "error"]
    assert len(errors) == 1 and "without a magnetometer" in errors[0].found
    (tmp_path / "session.toml").write_text(text + "heading_deg = 20\n")
    assert not [f for f in diagnose(tmp_path) if f.severity == "error"]
