import json
import tarfile

import numpy as np
import pytest

from fusecap.body.landmarks import landmark_set_named
from fusecap.errors import InputError
from fusecap.sources.keypoint_files import read_keypoints
from fusecap.sources.keypoint_tables import read_table
from fusecap.sources.session_cameras import open_keypoints, with_detections
from fusecap.sources.session_file import load_session
from session_files import write_keypoints

BODY25 = landmark_set_named("body25")


def read(folder, **options):
    return read_keypoints(folder, name="cam", landmarks=BODY25, rate_hz=25.0, **options)


def person(x=100.0, confidence=0.8):
    return np.column_stack([np.full(25, x), np.arange(25) + 10.0, np.full(25, confidence)])


def test_people_times_and_progress_come_back(tmp_path):
    write_keypoints(tmp_path / "a", [[person()], [], [person(), person(300)]], first=7)
    seen = []
    track = read(tmp_path / "a", offset_s=0.5, progress=lambda *step: seen.append(step))
    assert track.frames.tolist() == [7, 8, 9]
    assert np.allclose(track.times_s, [7 / 25 + 0.5, 8 / 25 + 0.5, 9 / 25 + 0.5])
    assert [len(people) for people in track.people] == [1, 0, 2]
    assert np.array_equal(track.people[2][1], person(300))
    assert seen == [("camera 'cam'", done, 3) for done in (1, 2, 3)]


def test_missing_keypoints_become_nan_with_confidence_0(tmp_path):
    body = person()
    body[3] = 0
    body[4, 2] = 0
    body[5, 0] = np.inf
    body[6, 2] = 1.7
    body[7, 2] = -0.4
    folder = tmp_path / "a"
    folder.mkdir()
    content = {"people": [{"pose_keypoints_2d": body.ravel().tolist()}]}
    (folder / "0.json").write_text(json.dumps(content))
    read_back = read(folder).people[0][0]
    for keypoint in (3, 4, 5, 7):
        assert np.isnan(read_back[keypoint, :2]).all() and read_back[keypoint, 2] == 0
    assert read_back[6, 2] == 1.0
    assert np.array_equal(read_back[8], body[8])


def test_nan_in_the_file_is_missing(tmp_path):
    content = json.dumps({"people": [{"pose_keypoints_2d": person().ravel().tolist()}]})
    (tmp_path / "0.json").write_text(content.replace("100.0", "NaN", 1))
    assert read(tmp_path).people[0][0, 0, 2] == 0


def test_person_without_keypoints_is_nobody(tmp_path):
    write_keypoints(tmp_path / "a", [[np.zeros((25, 3)), person()]])
    assert len(read(tmp_path / "a").people[0]) == 1
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "0.json").write_text('{"people": [{"pose_keypoints_2d": []}]}')
    assert len(read(tmp_path / "b").people[0]) == 0


@pytest.mark.parametrize(
    "name", ["0_000000000012_keypoints.json", "cam_02.00012.json", "12.json", "a-b_12.json"]
)
def test_any_name_with_a_trailing_frame_number_is_read(tmp_path, name):
    (tmp_path / name).write_text('{"people": []}')
    (tmp_path / "notes.json").write_text("{}")
    (tmp_path / "13.txt").write_text("")
    assert read(tmp_path).frames.tolist() == [12]


@pytest.mark.parametrize(
    "content",
    ['{"people": [{"pose_keypo', "", "[]", "{}", '{"people": 3}', '{"people": [{"a": 1}]}',
     '{"people": [{"pose_keypoints_2d": "xx"}]}',
     '{"people": [{"pose_keypoints_2d": [' + ", ".join(['"a"'] * 75) + "]}]}"],
)  # fmt: skip
def test_broken_file_among_good_ones_is_an_empty_frame(tmp_path, content):
    write_keypoints(tmp_path / "a", [[person()], [person()]])
    broken = sorted((tmp_path / "a").iterdir())[1]
    broken.write_text(content)
    track = read(tmp_path / "a")
    assert [len(people) for people in track.people] == [1, 0]
    assert track.broken == (broken.name,)


def test_folder_of_broken_files_is_refused(tmp_path):
    for frame in range(3):
        (tmp_path / f"{frame}.json").write_text("{")
    with pytest.raises(InputError, match="none of the 3 keypoint files"):
        read(tmp_path)


def test_other_keypoint_count_names_the_format_it_looks_like(tmp_path):
    write_keypoints(tmp_path / "a", [[np.ones((26, 3))]])
    with pytest.raises(InputError, match=r"26 keypoints, expected the 25.*'openpose-halpe26'"):
        read(tmp_path / "a")


def test_two_cameras_in_one_folder_are_refused(tmp_path):
    for name in ("left_7.json", "right_7.json"):
        (tmp_path / name).write_text('{"people": []}')
    with pytest.raises(InputError, match=r"left_7\.json and right_7\.json are both frame 7"):
        read(tmp_path)


def test_missing_and_empty_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read(tmp_path / "nothing")
    with pytest.raises(InputError, match="no keypoint files"):
        read(tmp_path)


def test_tables_of_other_programs_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "points.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match=r"points\.csv: is a file; .* folder .* FreeMoCap's 2D"):
        read(tmp_path / "points.csv")


def freemocap(path, cameras=2, *, dtype=np.float64, points=553):
    """A person whose points rise, unseen at times."""
    table = np.arange(cameras * 20 * points * 3, dtype=dtype).reshape(cameras, 20, points, 3)
    if np.issubdtype(dtype, np.floating):
        table[0, 3:6] = np.nan
        table[1, 7, 11] = np.nan
    np.save(path, table)
    return table


def test_freemocaps_array_gives_each_camera_its_row(tmp_path):
    table = freemocap(tmp_path / "a.npy")
    text = '[session]\nname = "s"\nrate_hz = 30\n'
    for name in ("left", "right"):
        text += f'\n[[camera]]\nname = "{name}"\nkeypoints = "a.npy"\n'
    (tmp_path / "session.toml").write_text(text)
    left, right = open_keypoints(with_detections(load_session(tmp_path)))
    assert left.landmarks.name == right.landmarks.name == "blazepose33"
    assert [len(people) for people in left.people] == [1] * 3 + [0] * 3 + [1] * 14
    columns = left.landmarks.of_keypoints(table[1, :, :33])[:, :, :2]
    assert np.allclose(right.people[2][0, :, :2], columns[2])
    shoulder = right.landmarks.index("left_shoulder")
    assert right.people[7][0, shoulder, 2] == 0 and right.people[8][0, shoulder, 2] == 1
    assert np.allclose(right.times_s, np.arange(20) / 30)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda path: freemocap(path, 3), "holds 3 cameras, 2 of the session"),
        (lambda path: freemocap(path, points=20), "an array of"),
        (lambda path: freemocap(path, dtype=np.int32), "an array of int32"),
        (lambda path: path.write_bytes(b"PK garbage"), "cannot be read as an array"),
        (lambda path: np.save(path, np.array([{}], dtype=object)), "an array of"),
        (
            lambda path: (freemocap(path), path.write_bytes(path.read_bytes()[:9000])),
            "is cut off",
        ),
    ],
)
def test_other_arrays_are_refused(tmp_path, make, told):
    make(tmp_path / "a.npy")
    with pytest.raises(InputError, match=told):
        read_table(tmp_path / "a.npy", 0, 2)


@pytest.mark.real_data
def test_shelf_keypoints_read(data_dir, tmp_path):
    with tarfile.open(data_dir / "shelf/openpose_body25.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    for camera in "01234":
        track = read(tmp_path / camera)
        assert track.frames[0] == 0 and track.frames[-1] == 300 and len(track.frames) == 301
        assert track.broken == ()
        people = np.concatenate(track.people)
        seen = people[people[:, :, 2] > 0]
        assert np.all(np.isfinite(seen)) and np.all(seen[:, :2] < [1050, 800])
