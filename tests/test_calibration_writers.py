import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.errors import CalibrationError, TakeError
from fusecap.geometry.camera import Camera, Rig
from fusecap.sources.calibration_files import load_rig, write_rig
from session_files import ring

NAMES = ["rig.toml", "camera_array.toml", "rig.qca.txt", "rig.json", "folder"]


def numbers(low: float, high: float):
    return st.floats(low, high, allow_nan=False, width=64)


NUMBERS = st.fixed_dictionaries(
    {
        "size": st.tuples(st.integers(2, 8000), st.integers(2, 8000)),
        "focal": st.tuples(numbers(100, 5000), numbers(100, 5000)),
        "centre": st.tuples(numbers(0, 4000), numbers(0, 4000)),
        "distortion": st.tuples(*[numbers(-1, 1)] * 5),
        "rotvec": st.tuples(*[numbers(-2, 2)] * 3),
        "translation": st.tuples(*[numbers(-20, 20)] * 3),
    }
)
LETTERS = st.characters(categories=("L", "N"), include_characters=" -_'&")
CAMERA_NAMES = st.text(LETTERS, min_size=1, max_size=12).filter(lambda text: text == text.strip())


def camera_of(name: str, drawn: dict) -> Camera:
    matrix = np.eye(3)
    matrix[[0, 1], [0, 1]] = drawn["focal"]
    matrix[:2, 2] = drawn["centre"]
    return Camera(
        name=name,
        size_px=drawn["size"],
        matrix=matrix,
        distortion=np.array(drawn["distortion"]),
        rotation=Rotation.from_rotvec(drawn["rotvec"]).as_matrix(),
        translation=np.array(drawn["translation"]),
    )


def assert_same(read: Rig, rig: Rig) -> None:
    assert sorted(read.names) == sorted(rig.names)
    for camera in rig.cameras:
        other = read[camera.name]
        assert other.size_px == camera.size_px
        for field in ("matrix", "distortion", "rotation", "translation"):
            assert np.allclose(getattr(other, field), getattr(camera, field), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40)
@given(
    drawn=st.lists(
        st.tuples(CAMERA_NAMES, NUMBERS),
        min_size=1,
        max_size=4,
        unique_by=lambda pair: pair[0].casefold(),
    )
)
def test_what_is_written_reads_back(tmp_path_factory, name, drawn):
    rig = Rig(cameras=tuple(camera_of(*pair) for pair in drawn))
    path = tmp_path_factory.mktemp("rig") / name
    write_rig(path, rig)
    assert_same(load_rig(path), rig)


@pytest.mark.parametrize("name", NAMES)
def test_every_format_states_its_unit(tmp_path, name):
    [first, *_] = write_rig(tmp_path / name, ring())
    assert any(unit in first.read_text() for unit in ("metres", " in mm", "centimetres"))


def test_toml_is_what_other_loaders_expect(tmp_path):
    rig = ring(11)
    [path] = write_rig(tmp_path / "rig.toml", rig, notes=["made by\na test"])
    data = tomllib.loads(path.read_text())
    assert path.read_text().startswith("# made by\n# a test\n")
    assert data.pop("metadata")["adjusted"] is False
    assert list(data) == sorted(data)
    for table, camera in zip(data.values(), rig.cameras, strict=True):
        assert set(table) == {"name", "size", "matrix", "distortions", "rotation", "translation"}
        assert table["name"] == camera.name
        rows = [*table["matrix"], table["distortions"], table["rotation"], table["translation"]]
        assert all(isinstance(value, float) for row in rows for value in row)
        assert np.allclose(Rotation.from_rotvec(table["rotation"]).as_matrix(), camera.rotation)


def test_caliscope_finds_its_cameras_by_number(tmp_path):
    [path] = write_rig(tmp_path / "camera_array.toml", ring(2))
    data = tomllib.loads(path.read_text())
    assert list(data) == ["cameras"]
    assert [table["cam_id"] for table in data["cameras"].values()] == [0, 1]


def test_turned_video_of_qualisys_is_not_assumed(tmp_path):
    [path] = write_rig(tmp_path / "rig.qca.txt", ring(1))
    assert 'viewrotation="0"' in path.read_text()
    assert 'right="1279"' in path.read_text()


def test_panoptic_translations_are_centimetres(tmp_path):
    rig = ring(1)
    [path] = write_rig(tmp_path / "rig.json", rig)
    entry = json.loads(path.read_text())["cameras"][0]
    assert np.allclose(np.ravel(entry["t"]), rig.cameras[0].translation * 100)


def test_rig_without_cameras_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="without cameras"):
        write_rig(tmp_path / "rig.toml", Rig(cameras=()))


def test_unknown_name_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(CalibrationError, match=r"\.toml.*\.qca\.txt.*\.json"):
        write_rig(tmp_path / "rig.xml", ring())


def test_folder_with_other_cameras_is_refused(tmp_path):
    write_rig(tmp_path / "rig", ring(2))
    write_rig(tmp_path / "rig", ring(2))
    with pytest.raises(CalibrationError, match="other cameras already"):
        write_rig(tmp_path / "rig", ring(1))


def test_camera_that_cannot_name_a_file_is_refused(tmp_path):
    camera = ring(1).cameras[0]
    rig = Rig(cameras=(Camera(**{**vars(camera), "name": "a/b"}),))
    with pytest.raises(CalibrationError, match="'a/b'"):
        write_rig(tmp_path / "rig", rig)
    assert_same(load_rig(write_rig(tmp_path / "rig.toml", rig)[0]), rig)


def test_unwritable_place_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TakeError, match="cannot write"):
        write_rig(tmp_path / "file" / "rig.toml", ring())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_easymocap_reads_back_from_the_folder_or_either_file(tmp_path):
    rig = ring(3)
    write_rig(tmp_path / "extri.yml", rig)
    for path in (tmp_path, tmp_path / "extri.yml", tmp_path / "intri.yml"):
        assert_same(load_rig(path), rig)


def test_easymocap_as_its_own_scripts_write_it(tmp_path):
    def matrix(key, rows, values):
        data = ", ".join(map(str, values))
        shape = f"  rows: {rows}\r\n  cols: {len(values) // rows}\r\n  dt: d\r\n"
        return f"{key}: !!opencv-matrix\r\n{shape}  data: [{data}]\r\n"

    head = '%YAML:1.0\r\n---\r\nnames:\r\n  - "01"\r\n'
    intrinsics = head + matrix("K_01", 3, [900, 0, 640, 0, 910, 360, 0, 0, 1])
    intrinsics += matrix("D_01", 1, [0.1, 0.02, 0, 0, 0])
    (tmp_path / "intri.yml").write_text(intrinsics, newline="")
    (tmp_path / "extri.yml").write_text(
        head + matrix("R_01", 3, [0, 0.5, 0]) + matrix("T_01", 3, [0.1, 0.2, 3.0]), newline=""
    )
    with pytest.raises(CalibrationError, match="add W_01 and H_01"):
        load_rig(tmp_path)
    sized = intrinsics + "H_01: 720\r\nW_01: 1280\r\n"
    (tmp_path / "intri.yml").write_text(sized, newline="")
    (camera,) = load_rig(tmp_path).cameras
    assert camera.name == "01" and camera.size_px == (1280, 720)
    assert camera.distortion[:2].tolist() == [0.1, 0.02]
    assert camera.translation.tolist() == [0.1, 0.2, 3.0]
    assert np.allclose(Rotation.from_matrix(camera.rotation).as_rotvec(), [0, 0.5, 0])


def calibio(rig: Rig, **parameters: float) -> dict:
    """As calib.io's Camera Calibrator writes them, in millimetres."""
    cameras = []
    for camera in rig.cameras:
        k1, k2, p1, p2, k3 = camera.distortion
        values = {
            "f": camera.matrix[0, 0],
            "ar": camera.matrix[1, 1] / camera.matrix[0, 0],
            "cx": camera.matrix[0, 2],
            "cy": camera.matrix[1, 2],
            **{"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2, "k4": 0.0, "tauX": 0.0},
            **parameters,
        }
        size = dict(zip(("width", "height"), camera.size_px, strict=True))
        data = {
            "CameraModelCRT": {"CameraModelBase": {"imageSize": size}},
            "parameters": {key: {"state": 0, "val": value} for key, value in values.items()},
        }
        model = {
            "polymorphic_name": "libCalib::CameraModelOpenCV",
            "ptr_wrapper": {"valid": 1, "data": data},
        }
        turn = Rotation.from_matrix(camera.rotation).as_rotvec()
        transform = {
            "rotation": dict(zip(("rx", "ry", "rz"), turn, strict=True)),
            "translation": dict(zip("xyz", 1000 * camera.translation, strict=True)),
        }
        cameras.append({"model": model, "transform": transform})
    return {"Calibration": {"cameras": cameras, "poses": []}}


def test_calibio_is_read_by_number_and_in_its_unit(tmp_path):
    path, rig = tmp_path / "calibration.json", ring()
    path.write_text(json.dumps(calibio(rig)))
    numbered = Rig(
        cameras=tuple(replace(camera, name=str(i)) for i, camera in enumerate(rig.cameras))
    )
    assert_same(load_rig(path, unit="mm"), numbered)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (
            lambda c: c["model"].update(polymorphic_name="libCalib::CameraModelFisheye"),
            "lens model",
        ),
        (lambda c: c.pop("transform"), "no transform.rotation"),
        (lambda c: c["transform"].update(rotation=[1, 2, 3]), "no transform.rotation"),
        (lambda c: c["model"]["ptr_wrapper"]["data"]["parameters"].pop("f"), "f: holds"),
        (lambda c: c["model"]["ptr_wrapper"]["data"]["parameters"].update(k4=3), "k4: holds"),
    ],
)
def test_calibio_that_is_not_whole_is_refused(tmp_path, spoil, told):
    path, document = tmp_path / "calibration.json", calibio(ring())
    spoil(document["Calibration"]["cameras"][0])
    path.write_text(json.dumps(document))
    with pytest.raises(CalibrationError, match=told):
        load_rig(path, unit="mm")


def test_lenses_of_more_terms_than_five_are_refused_in_calibio(tmp_path):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(calibio(ring(), k4=0.1)))
    with pytest.raises(CalibrationError, match="rational"):
        load_rig(path, unit="mm")
