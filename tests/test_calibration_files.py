import json
import time
from dataclasses import replace

import numpy as np
import pytest

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Y_UP_FROM_Z_UP, Rig
from fusecap.sources.calibration_files import check_rig, load_rig, write_rig
from session_files import calibration_toml, ring

POINTS = np.array([[0.3, 1.0, 0.2], [-0.2, 0.1, 0.4], [0.0, 1.7, -0.3]])


def write(path, text):
    path.write_text(text)
    return path


def assert_same_images(rig: Rig, other: Rig) -> None:
    for camera in rig.cameras:
        assert np.allclose(camera.project(POINTS), other[camera.name].project(POINTS), atol=1e-6)


def test_aniposelib_layout_reads_back(tmp_path):
    rig = ring()
    assert_same_images(load_rig(write(tmp_path / "c.toml", calibration_toml(rig))), rig)


def test_matrix_rotation_and_nested_tables_of_caliscope_read_back(tmp_path):
    rig = ring(2)
    text = ""
    for index, camera in enumerate(rig.cameras):
        text += (
            f"[cameras.{index}]\nsize = [1280, 720]\nmatrix = {camera.matrix.tolist()}\n"
            f"distortions = [0, 0, 0, 0]\nrotation = {camera.rotation.tolist()}\n"
            f"translation = {camera.translation.tolist()}\n"
        )
    read = load_rig(write(tmp_path / "camera_array.toml", text))
    assert read.names == ("cam_0", "cam_1")
    assert np.allclose(read["cam_1"].project(POINTS), rig["cam1"].project(POINTS))


def test_z_up_world_becomes_y_up(tmp_path):
    rig = ring()
    z_up = rig.in_world(Y_UP_FROM_Z_UP.T)
    read = load_rig(write(tmp_path / "c.toml", calibration_toml(z_up)), up="z")
    assert_same_images(read, rig)


def test_y_down_world_becomes_y_up(tmp_path):
    rig = ring()
    y_down = rig.in_world(np.diag([1.0, -1.0, -1.0]))
    read = load_rig(write(tmp_path / "c.toml", calibration_toml(y_down)), up="-y")
    assert_same_images(read, rig)


def test_millimetres_are_refused_with_the_remedy(tmp_path):
    path = write(tmp_path / "c.toml", calibration_toml(ring(), unit_per_metre=1000))
    with pytest.raises(CalibrationError, match='calibration_unit = "mm"'):
        load_rig(path)


def test_stated_millimetres_are_converted(tmp_path):
    path = write(tmp_path / "c.toml", calibration_toml(ring(), unit_per_metre=1000))
    assert_same_images(load_rig(path, unit="mm"), ring())


def test_metres_stated_as_millimetres_are_refused(tmp_path):
    path = write(tmp_path / "c.toml", calibration_toml(ring()))
    with pytest.raises(CalibrationError, match="in metres already"):
        load_rig(path, unit="mm")


def test_mirrored_rotation_is_refused(tmp_path):
    camera = ring(1).cameras[0]
    mirrored = camera.rotation * np.array([[1], [1], [-1.0]])
    text = (
        f"[a]\nsize = [1280, 720]\nmatrix = {camera.matrix.tolist()}\ndistortions = []\n"
        f"rotation = {mirrored.tolist()}\ntranslation = [0, 0, 4]\n"
    )
    with pytest.raises(CalibrationError, match=r"c\.toml: camera 'a'.*mirrors"):
        load_rig(write(tmp_path / "c.toml", text))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("size = [1280, 720]\n", "", "no size"),
        ("size = [1280, 720]", 'size = "big"', "'big'"),
        ("size = [1280, 720]", "size = [1280]", "found 1 numbers, expected 2"),
        ("size = [1280, 720]", "size = [1280, 720]\nfisheye = true", "fisheye"),
        ("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0, 0, 0, 0, 0, 0.1, 0, 0]", "8 distortion"),
        ("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0, 0]", "2 distortion"),
        ("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0, 0, 0, nan]", "not a number"),
        ("700.0", "-700.0", "focal"),
        ("700.0", "nan", "not a finite number"),
        ("[cam1]", "[cam0]", "not valid TOML"),
    ],
)
def test_broken_calibration_is_refused_with_place(tmp_path, old, new, expected):
    text = calibration_toml(ring(2))
    assert old in text
    path = write(tmp_path / "c.toml", text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=expected) as caught:
        load_rig(path)
    assert "c.toml" in str(caught.value)


def test_zero_coefficients_beyond_the_fifth_are_accepted(tmp_path):
    text = calibration_toml(ring()).replace("0.0, 0.0, 0.0, 0.0, 0.0]", "0, 0, 0, 0, 0, 0, 0, 0]")
    assert_same_images(load_rig(write(tmp_path / "c.toml", text)), ring())


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("cameraIntrinsicsExtrinsics.pickle", "", "OpenCap's .* intrinsicMat"),
        ("lens.yml", "%YAML:1.0\nfisheye_model: 1\n", "fisheye"),
        (
            "lens.xml",
            "<opencv_storage><fisheye_model>1</fisheye_model></opencv_storage>",
            "fisheye",
        ),
        ("lens.yaml", "%YAML:1.0\nfisheye_model: 0\n", "not a calibration that is known"),
    ],
)
def test_what_is_known_but_not_read_is_refused_by_name(tmp_path, name, content, told):
    with pytest.raises(CalibrationError, match=f"(?s){name}.*{told}"):
        load_rig(write(tmp_path / name, content))


def test_fisheye_lenses_beside_easymocaps_extrinsics_are_refused(tmp_path):
    write(tmp_path / "intri.yml", 'names:\n  - "1"\nfisheye_model: 1\n')
    write(tmp_path / "extri.yml", "")
    with pytest.raises(CalibrationError, match=r"intri\.yml.*fisheye"):
        load_rig(tmp_path)


@pytest.mark.parametrize("turned", ["90", "180", "270"])
def test_turned_cameras_of_qualisys_are_refused_where_the_session_uses_them(tmp_path, turned):
    path = tmp_path / "c.qca.txt"
    write_rig(path, ring(2))
    text = path.read_text().replace('viewrotation="0"', f'viewrotation="{turned}"', 1)
    write(path, text)
    with pytest.raises(CalibrationError, match=f"viewrotation {turned}.*unrotated"):
        load_rig(path)
    assert load_rig(path, names=["cam1"]).names == ("cam1",)


@pytest.mark.parametrize("name", ["c.toml", "c.json", "c.qca.txt", "c.xyz"])
def test_file_without_cameras_is_refused(tmp_path, name):
    content = {"c.toml": "a = 1", "c.json": "{}", "c.qca.txt": "<calibration/>", "c.xyz": ""}
    with pytest.raises(CalibrationError, match=name):
        load_rig(write(tmp_path / name, content[name]))


@pytest.mark.parametrize("name", ["c.json", "c.qca.txt", "c.toml"])
def test_truncated_file_is_refused(tmp_path, name):
    with pytest.raises(CalibrationError, match=r"not valid|broken or truncated"):
        load_rig(write(tmp_path / name, '{"a" <'))


def test_missing_and_empty_places_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="no such file"):
        load_rig(tmp_path / "nothing.toml")
    with pytest.raises(CalibrationError, match="no calibration file"):
        load_rig(tmp_path)


def test_document_types_are_not_expanded(tmp_path):
    bomb = '<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;">]><calibration>&c;</calibration>'
    with pytest.raises(CalibrationError, match="DOCTYPE"):
        load_rig(write(tmp_path / "c.qca.txt", bomb))


def test_folder_of_camera_json_reads_back(tmp_path):
    rig = ring()
    for camera in rig.cameras:
        pose = np.concatenate([camera.rotation, camera.translation[:, None]], axis=1)
        content = {
            "K": camera.matrix.ravel().tolist(),
            "RT": pose.ravel().tolist(),
            "imgSize": [1280, 720],
        }
        (tmp_path / f"{camera.name}.json").write_text(json.dumps(content))
    assert_same_images(load_rig(tmp_path), rig)
    with pytest.raises(CalibrationError, match="name the folder"):
        load_rig(tmp_path / "cam0.json")


def test_panoptic_centimetres_become_metres(tmp_path):
    rig = ring()
    cameras = [
        {
            "name": camera.name,
            "resolution": [1280, 720],
            "K": camera.matrix.tolist(),
            "distCoef": [0, 0, 0, 0, 0],
            "R": camera.rotation.tolist(),
            "t": (camera.translation[:, None] * 100).tolist(),
        }
        for camera in rig.cameras
    ]
    path = write(tmp_path / "calibration_x.json", json.dumps({"cameras": cameras}))
    assert_same_images(load_rig(path), rig)
    assert_same_images(load_rig(tmp_path), rig)


def test_qualisys_axes_and_units_are_converted(tmp_path):
    camera = ring(1).cameras[0]
    in_file = np.diag([1.0, -1.0, -1.0]) @ camera.rotation
    x, y, z = camera.position_in_world * 1000
    r = " ".join(f'r{i + 1}{j + 1}="{in_file[i, j]!r}"' for i in range(3) for j in range(3))
    text = (
        (
            '<calibration><cameras><camera active="1" serial="cam0">'
            '<fov_video left="0" top="0" right="1279" bottom="719"/>'
            f'<transform x="{x!r}" y="{y!r}" z="{z!r}" {r}/>'
            f'<intrinsic focalLengthU="{700 * 64}" focalLengthV="{700 * 64}" '
            f'centerPointU="{640 * 64}" centerPointV="{360 * 64}" radialDistortion1="0" '
            'radialDistortion2="0" radialDistortion3="0" tangentalDistortion1="0" '
            'tangentalDistortion2="0"/></camera></cameras></calibration>'
        )
        .replace("np.float64(", "")
        .replace(")", "")
    )
    assert_same_images(load_rig(write(tmp_path / "c.qca.txt", text)), ring(1))
    with pytest.raises(CalibrationError, match="focalLengthU"):
        load_rig(write(tmp_path / "c.qca.txt", text.replace("focalLengthU=", "f=")))


def test_sound_rig_has_no_findings():
    assert check_rig(ring()) == []


def test_implausible_rigs_are_found():
    def found(rig, floor=True):
        return " ".join(finding.found for finding in check_rig(rig, floor=floor))

    upside_down = ring().in_world(np.diag([1.0, -1.0, -1.0]))
    assert "upside down" in found(upside_down) and "below the floor" in found(upside_down)
    assert "below the floor" not in found(upside_down, floor=False)
    first = ring().cameras[0]
    twice = Rig(cameras=(first, replace(first, name="twin")))
    assert "same place" in found(twice)


def test_inverted_extrinsics_are_found():
    inverted = Rig(
        cameras=tuple(
            replace(
                camera,
                rotation=camera.rotation.T.copy(),
                translation=camera.position_in_world,
            )
            for camera in ring().cameras
        )
    )
    assert check_rig(inverted) != []


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("path", "up", "count", "first", "height_m"),
    [
        ("shelf/calibs", "z", 5, "0", 1.10),
        ("pose2sim_demo/v0.8.4_openpose_body25b/Calib.qca.txt", "z", 4, "cam_01", 1.90),
        ("pose2sim_demo/pose2sim_blender_examples/Pose2Sim_cameras.toml", "z", 4, "cam_01", 1.90),
        ("caliscope/post_optimization/camera_array.toml", "z", 4, "cam_0", -0.16),
        ("caliscope/post_optimization/config.toml", "z", 4, "cam_0", -0.16),
        (
            "format_samples/panoptic/160906_band1/calibration_160906_band1.json",
            "-y",
            520,
            "01_01",
            1.65,
        ),
    ],
)
def test_real_calibrations_are_plausible(data_dir, path, up, count, first, height_m):
    rig = load_rig(data_dir / path, up=up)
    assert len(rig) == count
    assert rig[first].position_in_world[1] == pytest.approx(height_m, abs=0.01)
    assert check_rig(rig) == []


@pytest.mark.real_data
def test_qualisys_and_toml_of_one_rig_agree(data_dir):
    folder = data_dir / "pose2sim_demo"
    qualisys = load_rig(folder / "v0.8.4_openpose_body25b/Calib.qca.txt", up="z")
    toml = load_rig(folder / "pose2sim_blender_examples/Pose2Sim_cameras.toml", up="z")
    for camera in qualisys.cameras:
        difference = camera.project(POINTS) - toml[camera.name].project(POINTS)
        assert np.nanmax(np.abs(difference)) < 6.0


@pytest.mark.real_data
def test_shelf_folder_agrees_with_its_other_format(data_dir):
    rig = load_rig(data_dir / "shelf/calibs")
    other = json.loads(
        (
            data_dir / "format_samples/shelf_campus_voxelpose_format/calibration_shelf.json"
        ).read_text()
    )
    for camera in rig.cameras:
        centre_m = np.ravel(other[camera.name]["T"]) / 1000
        assert np.allclose(camera.position_in_world, centre_m, atol=2e-3)
        assert np.allclose(camera.rotation, other[camera.name]["R"], atol=1e-4)


def test_thousands_of_cameras_are_refused_at_once(tmp_path):
    one = calibration_toml(ring(1)).removeprefix("[cam0]")
    path = tmp_path / "calibration.toml"
    path.write_text("".join(f"[c{i}]{one}\n" for i in range(10_000)))
    started_s = time.process_time()
    with pytest.raises(CalibrationError, match="10000 cameras; at most 1024"):
        load_rig(path)
    assert time.process_time() - started_s < 10
