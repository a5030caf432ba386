"""`fusecap live` as its users call it, on a recording that is played as if live."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from session_files import edit, write_session


def fusecap(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fusecap", "live", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """Two seconds of one person, four cameras at 30 Hz."""
    return write_session(tmp_path_factory.mktemp("live")).parent


@pytest.mark.slow
def test_a_recording_played_as_if_live_is_solved_recorded_and_reported(session, tmp_path):
    recording = tmp_path / "run.mcap"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        port = receiver.getsockname()[1]
        done = fusecap(
            session,
            "--playback",
            "--to",
            f"osc://127.0.0.1:{port}",
            "--record",
            recording,
            "--json",
        )
        assert receiver.recv(65536).startswith(b"#bundle\0")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    report = json.loads(done.stdout)
    assert report["instants"] > 30
    assert report["detections"] > 200
    assert max(person["tracked_share"] for person in report["subjects"].values()) > 0.5
    assert report["streams"][0]["sent"] > 30
    assert report["recordings"][0]["path"] == str(recording)
    assert report["threads_left"] == []
    assert recording.stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "signals"), [(signal.SIGINT, 1), (signal.SIGINT, 2), (signal.SIGHUP, 1)]
)
def test_a_signal_ends_a_run_with_success_and_a_whole_recording(session, tmp_path, number, signals):
    from fusecap.recording.reader import Recording

    recording = tmp_path / "run.mcap"
    arguments = [session, "--playback", "--loop", "--record", recording, "--json"]
    with subprocess.Popen(
        [sys.executable, "-m", "fusecap", "live", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as running:
        while not (recording.is_file() and recording.stat().st_size > 20_000):
            assert running.poll() is None, running.communicate()[1]
        for _ in range(signals):
            running.send_signal(number)
        out, error = running.communicate(timeout=60)
    # A second signal that comes when all is written may find Python itself already leaving.
    assert running.returncode == 0 or (signals == 2 and running.returncode == -signal.SIGINT), error
    assert json.loads(out)["instants"] > 0
    read = Recording(recording)
    assert list(read.items())
    assert read.loss.finished and read.loss.whole


@pytest.mark.slow
def test_a_killed_stream_process_is_an_incident_and_is_started_again(session):
    def children(pid: int) -> list[int]:
        return [
            int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        ]

    arguments = [session, "--playback", "--loop", "--no-record", "--seconds", 8, "--json"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60)
        arguments += ["--to", f"osc://127.0.0.1:{receiver.getsockname()[1]}"]
        with subprocess.Popen(
            [sys.executable, "-m", "fusecap", "live", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as running:
            receiver.recv(65536)
            for child in children(running.pid):
                os.kill(child, signal.SIGKILL)
            out, error = running.communicate(timeout=60)
    assert running.returncode == 0 and error == ""
    told = [incident["what"] for incident in json.loads(out)["incidents"]]
    assert any("killed by signal 9" in what for what in told), told
    assert "streams: sent again" in told


@pytest.mark.slow
def test_a_run_that_ends_without_streams_fails(session, tmp_path):
    script = tmp_path / "down.py"
    script.write_text(
        "import fusecap.live.streaming as s\n"
        "s.Streaming.down = property(lambda self: True)\n"
        "from fusecap.cli import main\nmain()\n"
    )
    command = [sys.executable, script, "live", session, "--playback", "--no-record"]
    command += ["--seconds", 1, "--to", "osc"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "streams were not sent" in done.stderr


@pytest.mark.slow
def test_a_refused_port_leaves_no_recording(session, tmp_path):
    folder = tmp_path / "own"
    shutil.copytree(session if session.is_dir() else session.parent, folder)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for option in (["--view", "--view-port", port], ["--to", f"ws://127.0.0.1:{port}"]):
            done = fusecap(folder, "--playback", "--seconds", 1, *option)
            assert done.returncode == 1 and str(port) in done.stderr
    assert not list(folder.rglob("*.mcap"))


@pytest.mark.slow
def test_a_stalled_camera_is_told_of(session):
    done = fusecap(
        session, "--playback", "--loop", "--no-record", "--seconds", 4, "--stall", "cam1:0.5:1.5"
    )
    assert done.returncode == 0, done.stderr
    assert "camera 'cam1': nothing for 1 s" in done.stdout
    assert "camera 'cam1': back" in done.stdout
    assert "solves/s" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no camera and no imu says where it is found live"),
        (["--loop"], "are about recorded files; add --playback"),
        (["--playback", "--stall", "cam1:x:2"], "--stall cam1:x:2: expected CAMERA:START:LENGTH"),
        (["--playback", "--stall", "cam1:-1:2"], "a start from 0"),
        (["--playback", "--stall", "cam9:1:2"], "no source 'cam9' to stall"),
        (["--playback", "--no-record", "--record", "x.mcap"], "leave it or --record out"),
        (["--playback", "--record", "x.npz"], "a recording is one .mcap file"),
        (["--playback", "--to", "vcm"], "did you mean 'vmc'"),
        (["--playback", "--to", "ws://0.0.0.0:8765"], "add --host 0.0.0.0"),
        (["--playback", "--host", "0.0.0.0"], "--host is the address on which ws serves"),
    ],
)
def test_command_refuses_with_a_reason(session, monkeypatch, capsys, arguments, message):
    from fusecap.cli import main

    monkeypatch.setattr("sys.argv", ["fusecap", "live", str(session), *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert message in capsys.readouterr().err
    assert not list(session.glob("*.mcap"))


def test_a_camera_with_other_keypoints_than_the_detector_is_refused(tmp_path, monkeypatch):
    from fusecap.errors import SessionError
    from fusecap.live import opening
    from fusecap.sources.session_file import load_session
    from live_fakes import FakeDetector

    file = write_session(tmp_path, frames=2)
    edit(file, 'keypoints = "keypoints/cam0"', 'live = "webcam:0"')
    edit(file, 'name = "cam1"', 'name = "cam1"\nlive = "openpose:keypoints/cam1"')
    edit(file, 'name = "cam2"', 'name = "cam2"\nformat = "openpose-halpe26"')
    monkeypatch.setattr(
        opening, "build_detector", lambda *given, **options: FakeDetector(lambda images: None)
    )
    with pytest.raises(SessionError, match="camera 'cam2' brings halpe26 keypoints, the detector"):
        opening.open_setup(load_session(file), playback=False)


def test_what_has_no_live_key_is_listed(tmp_path):
    from fusecap.live.opening import check_live
    from fusecap.sources.session_file import load_session

    file = write_session(tmp_path, frames=2)
    edit(file, 'name = "cam1"', 'name = "cam1"\nlive = "openpose:keypoints/cam1"')
    assert check_live(load_session(file)) == ["camera 'cam0'", "camera 'cam2'", "camera 'cam3'"]
