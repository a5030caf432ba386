"""Small sound files of every kind that is read, and what a hostile hand makes of them."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
from scipy.io import savemat

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.prior import load_prior, save_prior
from fusecap.body.skeleton import PAPER21
from fusecap.calibrate.cameras.board import read_board
from fusecap.calibrate.cameras.board_views import read_grey, read_timestamps
from fusecap.evaluate.datasets.safe_pickle import load_pickle
from fusecap.evaluate.datasets.shelf import load_truth, read_actors
from fusecap.inputs import MOTION, read_text
from fusecap.motion.files import motion_formats
from fusecap.recording.reader import Recording
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.calibration_files.writer import write_rig
from fusecap.sources.detection_files import read_record
from fusecap.sources.imu_calibration_files import (
    CalibratedImu,
    imu_calibration_toml,
    read_imu_calibration,
)
from fusecap.sources.imu_files import read_imu
from fusecap.sources.keypoint_files import read_people
from fusecap.sources.marked_points import read_marked_points
from fusecap.sources.offset_files import offsets_toml, read_offsets
from fusecap.sources.session_file import parse_session
from fusecap.sources.sync_files import Clock, Clocks, read_sync, sync_toml
from fusecap.sources.video import Video
from fusecap.stored_take import load_take
from fusecap.take import save_take
from motions import person, take_of, walk
from recorded_run import record, simulated_run
from session_files import ring, write_session
from video_files import write_video

Read = Callable[[Path], object]

ODD = (
    *(b"1e999", b"-1", b"nan", b"0", b"99999999999999999999", b"1e-320", b"\xff\xfe", b"[" * 300),
    *(b'"', b"}", b"\x00", b"\n" * 20, b"-", b"e", b",", b"<!DOCTYPE x>", b"9" * 5000, b"inf"),
)


def read_recording(path: Path) -> None:
    list(Recording(path).items())


def read_bvh(path: Path) -> object:
    text = read_text(path, MOTION, strict=False)
    return motion_formats()[".bvh"].parse(text, str(path), {})


def read_video(path: Path) -> None:
    list(Video(path).frames())


def read_record_beside(path: Path) -> None:
    beside = path.with_name("detection.json")
    path.replace(beside)
    read_record(path.parent)


def seeds(folder: Path) -> dict[str, tuple[bytes, Read]]:
    """By file name a sound content and its reader."""
    folder.mkdir(parents=True, exist_ok=True)
    body25, rig = landmark_set_named("body25"), ring(2)
    found: dict[str, tuple[bytes, Read]] = {}

    def add(name: str, content: bytes | str, read: Read) -> None:
        found[name] = (content.encode() if isinstance(content, str) else content, read)

    session = write_session(folder / "session", frames=2, cameras=2)
    add("session.toml", session.read_text(), parse_session)
    frame = next((session.parent / "keypoints").rglob("*.json"))
    add(frame.name, frame.read_bytes(), lambda path: read_people(path, body25))
    for name in ("rig.toml", "rig.json", "rig.qca.txt"):
        (file,) = write_rig(folder / name, rig)
        add(name, file.read_bytes(), load_rig)
    add("sync.toml", sync_toml(Clocks(cameras={"a": Clock(offset_s=1.0)}), origin="x"), read_sync)
    imu = CalibratedImu(
        subject="a", bone="head", bone_from_imu_wxyz=(1.0, 0.0, 0.0, 0.0), heading_deg=1.0
    )
    add("imu.toml", imu_calibration_toml([imu], origin="x"), read_imu_calibration)
    add("off.toml", offsets_toml(body25, origin="x"), lambda path: read_offsets(path, "body25"))
    add(
        "board.toml",
        'kind = "charuco"\ncolumns = 4\nrows = 5\nsquare_m = 0.05\nmarker_m = 0.03\n'
        'dictionary = "DICT_4X4_100"\n',
        read_board,
    )
    add(
        "points.csv",
        "name,x_m,y_m,z_m,left_u_px,left_v_px\na,0,0,0,1,2\nb,1,0,0,,\n",
        lambda path: read_marked_points(path, ("left",)),
    )
    add("stamps.csv", "sync_index,cam_id,frame_time\n0,1,0.1\n1,1,0.2\n", read_timestamps)
    take = take_of(walk(person(), 3)[None], [person()], names=("anna",))
    save_take(take, folder / "take.npz")
    add("take.npz", (folder / "take.npz").read_bytes(), load_take)
    save_prior(load_prior(PAPER21), folder / "prior.npz")
    add("prior.npz", (folder / "prior.npz").read_bytes(), lambda path: load_prior(PAPER21, path))
    with (folder / "run.mcap").open("wb") as file:
        record(file, *simulated_run(folder / "run", seconds=0.2))
    add("run.mcap", (folder / "run.mcap").read_bytes(), read_recording)
    add("video.mp4", write_video(folder / "video.mp4", 4).read_bytes(), read_video)
    times = {"frame": [0, 1], "size": (64, 48)}
    record_json = {
        "format": "fusecap keypoints 1",
        "landmark_set": "body25",
        "detector": "x",
        "video": {"name": "a.mp4", "bytes": 1, "sha256": "0", "size_px": times["size"]}
        | {"rate_hz": 30.0, "variable_rate": False},
        "times_ns": [0, 33_000_000],
        "complete": True,
    }
    add("record.json", json.dumps(record_json), read_record_beside)
    bvh = (
        "HIERARCHY\nROOT Hips\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition "
        "Zrotation Xrotation Yrotation\n End Site\n {\n  OFFSET 0 1 0\n }\n}\n"
        "MOTION\nFrames: 2\nFrame Time: 0.01\n0 0 0 0 0 0\n1 1 1 1 1 1\n"
    )
    add("motion.bvh", bvh, read_bvh)
    add("gt.txt", "15 1\n1\n0\n" + " ".join(["1.0"] * 60), load_truth)
    cells = np.empty((1, 2), dtype=object)
    cells[:] = [[np.zeros((14, 3)), np.zeros((1, 1))]]
    savemat(folder / "gt.mat", {"actor3D": cells})
    add("gt.mat", (folder / "gt.mat").read_bytes(), read_actors)
    add("data.pkl", pickle.dumps({"a": np.arange(4.0), "b": [1, "x"]}, 2), load_pickle)
    for format, head, row in (
        ("csv", "time_s,qw,qx,qy,qz,ax,ay,az", "{t},1,0,0,0,0,9.8,0"),
        (
            "xsens-dot",
            "PacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z,FreeAcc_X,FreeAcc_Y,FreeAcc_Z",
            "{n},{u},1,0,0,0,0,0,0",
        ),
        (
            "xsens-mt",
            "// Update Rate: 60.0Hz\nPacketCounter\tQuat_q0\tQuat_q1\tQuat_q2\tQuat_q3\tAcc_X\t"
            "Acc_Y\tAcc_Z",
            "{n}\t1\t0\t0\t0\t0\t0\t9.8",
        ),
        ("sto", "DataRate=60.0\nDataType=Quaternion\nendheader\ntime\thead_imu", "{t}\t1,0,0,0"),
    ):
        rows = [row.format(t=n / 60, n=n, u=n * 16667) for n in range(4)]
        add(
            f"{format}.csv",
            "\n".join([head, *rows]) + "\n",
            lambda path, format=format: read_imu(path, format=format, rate_hz=60.0),
        )
    add("grey.png", _png(), read_grey)
    return found


def _png() -> bytes:
    import cv2

    return cv2.imencode(".png", np.arange(64, dtype=np.uint8).reshape(8, 8))[1].tobytes()


def spoilt(content: bytes, random: Random) -> bytes:
    """The content after one to four blows."""
    data = bytearray(content)
    for _ in range(random.randint(1, 4)):
        at = random.randrange(len(data) + 1)
        end = min(len(data), at + random.choice((1, 1, 4, 16, 200)))
        match random.randrange(7):
            case 0 if at < len(data):
                data[at] ^= 1 << random.randrange(8)
            case 1:
                del data[at:end]
            case 2:
                data[at:at] = random.choice(ODD)
            case 3:
                data[at:end] = random.choice(ODD)
            case 4:
                data[at:at] = data[at:end] * random.choice((1, 3, 50))
            case 5:
                del data[at:]
            case _:
                data[at:end] = random.randbytes(end - at)
    return bytes(data)
