"""Files from outside: pipes, devices, floods, bombs and garbage end in a message, at once."""

from __future__ import annotations

import ast
import io
import os
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

import fusecap
from fusecap import inputs
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.prior import load_prior
from fusecap.body.skeleton import PAPER21
from fusecap.calibrate.cameras.board import read_board
from fusecap.calibrate.cameras.board_views import read_grey, read_timestamps
from fusecap.detect.runtimes.choice import open_network
from fusecap.errors import FusecapError, InputError
from fusecap.evaluate.datasets.safe_pickle import load_npz_object, load_pickle
from fusecap.evaluate.datasets.shelf import load_truth, read_actors
from fusecap.evaluate.scene_motion import load_motion
from fusecap.exports.characters.character import read_character
from fusecap.inputs import CALIBRATION, SETTINGS, TAKE, check_input, read_json, read_npz, read_toml
from fusecap.recording.reader import Recording
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.detection_files import read_record
from fusecap.sources.imu_calibration_files import read_imu_calibration
from fusecap.sources.imu_files import read_imu
from fusecap.sources.imu_files.formats import NAMES as IMU_FORMATS
from fusecap.sources.keypoint_files import read_people
from fusecap.sources.marked_points import read_marked_points
from fusecap.sources.offset_files import read_offsets
from fusecap.sources.session_file import load_session
from fusecap.sources.sync_files import read_sync
from fusecap.sources.video import Video
from fusecap.stored_take import load_take

PACKAGE = Path(fusecap.__file__).parent


def keypoints_of(path: Path) -> None:
    if read_people(path, landmark_set_named("body25")) is None:
        raise InputError("broken")


def record_of(path: Path) -> None:
    path.rename(path.with_name("detection.json"))
    read_record(path.parent)


READERS = {
    "session.toml": load_session,
    "sync.toml": read_sync,
    "imu.toml": read_imu_calibration,
    "offsets.toml": lambda path: read_offsets(path, "body25"),
    "board.toml": read_board,
    "rig.toml": load_rig,
    "rig.json": load_rig,
    "rig.qca.txt": load_rig,
    "000000000001_keypoints.json": keypoints_of,
    "record.json": record_of,
    "points.csv": lambda path: read_marked_points(path, ("left",)),
    "timestamps.csv": read_timestamps,
    "picture.png": read_grey,
    "video.mp4": Video,
    "run.mcap": Recording,
    "take.npz": load_take,
    "prior.npz": lambda path: load_prior(PAPER21, path),
    "motion.bvh": load_motion,
    "motion.npz": load_motion,
    "network.onnx": open_network,
    "character.glb": read_character,
    "truth.txt": load_truth,
    "truth.mat": read_actors,
    "data.pkl": load_pickle,
    "data.npz": lambda path: load_npz_object(path, "x"),
    **{
        f"{name}.{'mvnx' if name == 'mvnx' else 'csv'}": lambda path, name=name: read_imu(
            path, format=name, sensor="x", rate_hz=60.0
        )
        for name in IMU_FORMATS
    },
}


@pytest.mark.parametrize("name", READERS)
def test_no_reader_waits_for_a_pipe(name, tmp_path):
    path = tmp_path / name
    os.mkfifo(path)
    with pytest.raises(FusecapError, match=r"is a pipe|broken"):
        READERS[name](path)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("to", ["/dev/zero", "/dev/full", "socket", "folder"])
def test_no_reader_takes_a_device_a_socket_or_a_folder(name, to, tmp_path):
    path = tmp_path / name
    if to == "folder":
        path.mkdir()
    elif to == "socket":
        import socket

        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    else:
        path.symlink_to(to)
    tracemalloc.start()
    try:
        with pytest.raises(FusecapError):
            READERS[name](path)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", [n for n in READERS if n not in ("video.mp4", "run.mcap")])
def test_no_reader_takes_more_bytes_than_its_kind_may_have(name, tmp_path):
    path = tmp_path / name
    with path.open("wb") as file:
        file.truncate(5 << 30)  # a hole: no byte of it is on the disk
    with pytest.raises(FusecapError, match=r"may have|broken"):
        READERS[name](path)


def test_an_hour_of_frame_times_is_read(tmp_path):
    path = tmp_path / "timestamps.csv"
    row = "".join(f"{camera},1760000000.123456789\n" for camera in range(4))
    path.write_text("cam_id,frame_time\n" + row * 190_000)
    assert path.stat().st_size > 16e6
    assert inputs.read_text(path, inputs.FRAME_TIMES)


def test_a_file_that_states_no_size_is_read_as_far_as_its_kind_goes(monkeypatch):
    """As those below /proc do."""
    small = inputs.InputKind(what="a few bytes", most_bytes=10)
    with pytest.raises(InputError, match="may have 10"):
        inputs.read_bytes("/proc/self/status", small)


@pytest.mark.parametrize("name", [n for n in READERS if n.endswith((".toml", ".json"))])
@pytest.mark.parametrize("nested", [100, 100_000])
def test_text_nested_too_deeply_is_refused(name, nested, tmp_path):
    path = tmp_path / name
    text = "[" * nested + "]" * nested
    path.write_text(f"a = {text}" if name.endswith(".toml") else text)
    with pytest.raises(FusecapError, match=r"in each other|broken"):
        READERS[name](path)


@pytest.mark.parametrize("digits", [100, 10_000])
@pytest.mark.parametrize("name", [n for n in READERS if n.endswith((".toml", ".json"))])
def test_numbers_of_many_digits_are_refused(name, digits, tmp_path):
    path = tmp_path / name
    number = "9" * digits
    path.write_text(f"a = {number}" if name.endswith(".toml") else f'{{"people": [{number}]}}')
    with pytest.raises(FusecapError, match=r"whole number|digits|broken"):
        READERS[name](path)


@pytest.mark.parametrize("name", ["a folder", "a pipe", "a device"])
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="no /proc")
def test_what_is_refused_is_closed(name, tmp_path):
    path = tmp_path / "x.toml"
    if name == "a folder":
        path.mkdir()
    elif name == "a pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/null")
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(20):
        with pytest.raises(InputError, match=f"is {name}"):
            read_toml(path, SETTINGS)
    assert len(os.listdir("/proc/self/fd")) == before


_LONG = "a" + ".a" * 20_000


@pytest.mark.parametrize(
    "text",
    [
        f'"\u2028# ".{_LONG} = 1',
        f'x = ["""\n# """, {{{_LONG} = 1}}]',
        f'x = ["""a"""", {{{_LONG} = 1}}]',
        f"x = ['''\n# a'''', {{{_LONG} = 1}}]",
        f'x = ["\\"", {{{_LONG} = 1}}] # "',
        f"[ {_LONG} ]\nx = 1",
        "1" + ".1" * 20_000 + " = 1",
        " . ".join(["'a'", '"b"', "c"] * 7_000) + " = 1",
        "[" + "a." * 3_000 + "a]\n" + "".join(f"b{n} = 1\n" for n in range(1000)),
    ],
    ids=range(9),
)
def test_no_key_of_many_parts_hides(text, tmp_path):
    """Behind what looks like a comment or a string, or as numbers."""
    path = tmp_path / "long.toml"
    path.write_text(text, encoding="utf-8")
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="so many parts"):
            read_toml(path, SETTINGS)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "text",
    [
        "x = [" + "1.5, " * 20_000 + "]",
        "[a.b.c]\nx = [" + "[1.5, -2.5e-3],\n" * 10_000 + "]",
        "x = '" + "a." * 50_000 + "'",
        'x = """\n' + "a.b\n" * 50_000 + '"""',
        "x = 1 # " + "a." * 50_000,
        "d = [" + "2026-01-01T00:00:00.5, " * 5_000 + "]",
    ],
    ids=["one line of floats", "rows", "text", "long text", "comment", "dates"],
)
def test_dots_that_join_no_names_are_free(text, tmp_path):
    path = tmp_path / "fine.toml"
    path.write_text(text)
    assert read_toml(path, SETTINGS)


@pytest.mark.parametrize(
    "piece", ['"\\"', "\\", '"', "'", '"""\\', "'''a", "a.", "a .", "#", "[a."]
)
def test_the_search_for_keys_takes_time_by_length_alone(piece, tmp_path):
    path = tmp_path / "odd.toml"
    path.write_text("x = " + piece * (1_000_000 // len(piece)))
    started = time.process_time()
    with pytest.raises(InputError):
        read_toml(path, SETTINGS)
    assert time.process_time() - started < 5


@pytest.mark.parametrize(
    "text",
    ["a" + ".a" * 20_000 + " = 1", "[" + "a." * 3_000 + "a]\n" + "b.c = 1\n" * 100_000],
    ids=["one key", "many below one table"],
)
def test_keys_of_many_parts_are_refused_before_they_are_parsed(text, tmp_path):
    path = tmp_path / "long.toml"
    path.write_text(text)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="so many parts"):
            read_toml(path, SETTINGS)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_what_people_write_is_read(tmp_path):
    path = tmp_path / "some.toml"
    path.write_text("\ufeff# " + "." * 4000 + '\na.b = "c.d"\nx = [[1.5, 2.5], [3.5]]\r\n')
    assert read_toml(path, SETTINGS) == {"a": {"b": "c.d"}, "x": [[1.5, 2.5], [3.5]]}
    path.write_text('{"a": [1, 2.5, null]}')
    assert read_json(path, CALIBRATION) == {"a": [1, 2.5, None]}


def entry(shape: tuple[int, ...], descr: str, data: bytes = b"") -> bytes:
    """An array whose header states what is not there."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": descr, "fortran_order": False, "shape": shape}
    )
    return file.getvalue() + data


@pytest.mark.parametrize(
    ("shape", "descr"),
    [
        ((10**15,), "<f8"),
        ((10**9, 10**9, 10**9), "<f8"),
        ((10**12,), "<U0"),
        ((2,), "|O"),
        ((2,), "<c16"),
        ((2,), "<M8[s]"),
    ],
)
def test_arrays_that_cannot_be_are_refused(shape, descr, tmp_path):
    path = tmp_path / "take.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("format.npy", entry(shape, descr, bytes(32)))
    with pytest.raises(FusecapError, match=r"format\.npy"):
        read_npz(path, TAKE, ("format",))


def test_bombs_are_refused_and_those_in_entries_nobody_needs_left_alone(tmp_path):
    kind = inputs.InputKind(what="small", most_bytes=1 << 20)
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("bomb.npy", "w") as member:
            member.write(entry((8 << 20,), "|u1"))
            for _ in range(8):
                member.write(bytes(1 << 20))
        with archive.open("fine.npy", "w") as member:
            np.save(member, np.arange(3))
    assert list(read_npz(path, kind, ("fine", "missing"))) == ["fine"]
    with pytest.raises(InputError, match="unpacks to"):
        read_npz(path, kind, ("bomb",))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("fine.npy", bytes(1000))
    with pytest.raises(InputError, match="packed in an unknown way"):
        read_npz(path, kind, ("fine",))
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(inputs.MOST_ENTRIES + 1):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(InputError, match="entries"):
        read_npz(path, kind, ("1",))


def test_nothing_else_opens_files_from_outside():
    """Every call that reads a file stands in `inputs.py`, or reads what is fusecap's own."""
    own = {
        "inputs.py",
        "files.py",  # writes
        "kernels/jit.py",  # the stamp of the compiled cache
        "evaluate/code_version.py",  # the package's own modules
        "body/motion_model.py",  # shipped
        "live/health.py",  # /proc/self
        "live/devices/grabbers.py",  # cameras
        "live/recorder.py",  # writes
        "exports/overlay.py",  # writes
        "exports/library.py",  # what a library has just written
        "exports/formats/c3d.py",  # a head that ezc3d has just written
        "exports/fbx_motion.py",  # what Blender has just written
        "take.py",  # writes
        "exports/formats/html.py",  # shipped
        "streams/stream.py",  # opens a protocol
        "cli/view.py",  # opens a browser
        "cli/__init__.py",  # the null device
        "interrupts.py",  # the null device
    }
    reading = {"read_text", "read_bytes", "open", "imread", "VideoCapture", "loadtxt", "genfromtxt"}
    bare = {"open", "ZipFile", "loadmat"}
    reading |= bare | {"fromfile", "memmap"}
    after_a_check = {("sources/video.py", "open"), ("detect/model_store.py", "open")}
    after_a_check.add(("detect/model_store.py", "ZipFile"))  # what it has just downloaded
    found = []
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if name in own:
            continue
        source = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)):
            if not isinstance(node, ast.Call):
                continue
            called = node.func
            *owner, attr = ast.unparse(called).split(".")
            loads = attr in (reading if owner else bare) or (owner, attr) == (["np"], "load")
            if not loads or (name, attr) in after_a_check:
                continue
            opened = bool(node.args) and ast.unparse(node.args[0]) == "file"
            if owner[:1] in (["archive"], ["tarfile"]) or (opened and "open_input(" in source):
                continue
            found.append((name, node.lineno))
    assert found == []


def test_a_file_that_is_missing_names_those_beside_it(tmp_path):
    for name in ("kam_s1.npz", "truth.npz", "session.toml"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"no such file; .*; there is kam_s1.npz, truth.npz$"):
        check_input(tmp_path / "walker.npz", TAKE)
    with pytest.raises(InputError, match=r"expected a take \(\.npz\)$"):
        check_input(tmp_path / "nowhere" / "walker.npz", TAKE)
