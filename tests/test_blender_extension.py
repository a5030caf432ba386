"""The Blender extension, from its zip, in a Blender without a window."""

import contextlib
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import fusecap
from export_people import NEAR_M, environment, run_reader, two_walkers, with_gap
from fusecap.take import save_take
from motions import person
from test_retarget_character import character_file, in_armature, world_of

PANEL = [
    *("import_anim.fusecap_take", "fusecap_address", "fusecap_record"),
    *("scene.fusecap_connect", "scene.fusecap_disconnect", "object.fusecap_retarget"),
    "import_anim.fusecap_take",
]
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def extension(tmp_path) -> Path:
    """The folder that holds the unpacked extension."""
    build = ROOT / "integrations" / "blender" / "build.py"
    told = subprocess.run(
        [sys.executable, build, tmp_path], capture_output=True, text=True, check=True
    )
    archive = Path(told.stdout.removeprefix("wrote ").strip())
    with zipfile.ZipFile(archive) as file:
        assert {"__init__.py", "blender_manifest.toml", "bone_words.py"} <= {*file.namelist()}
        file.extractall(tmp_path / "extension" / "fusecap_motion")
    return tmp_path / "extension"


@contextlib.contextmanager
def streaming(take: Path):
    """`fusecap stream` of a take, in a loop; gives the address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"ws://127.0.0.1:{port}"
    command = [sys.executable, "-m", "fusecap", "stream", take, "--to", address, "--loop"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            for _ in range(300):
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                    break
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(0.1)
            yield address
        finally:
            process.terminate()


@pytest.mark.slow
def test_takes_and_streams_become_armatures_that_move_and_move_characters(tmp_path, extension):
    python = environment("FUSECAP_BPY_PYTHON", "bpy")
    (archive,) = tmp_path.glob("*.zip")
    scripts = "import bpy; print(bpy.utils.system_resource('SCRIPTS'))"
    told = subprocess.run([python, "-c", scripts], capture_output=True, text=True, check=True)
    checker = Path(told.stdout.splitlines()[-1]) / "addons_core/bl_pkg/cli/blender_ext.py"
    subprocess.run([python, checker, "validate", archive], check=True)
    take = with_gap(two_walkers(60, names=("anna", "Zoë/2")), [20, 21])
    save_take(take, tmp_path / "t.npz")
    out = tmp_path / "out.npz"
    mixamo = character_file(tmp_path / "mixamo.glb", rig="mixamo", shape=person(1.9))
    plain = character_file(tmp_path / "plain.glb", rig="ue5", shape=person(1.2))
    characters = [mixamo, in_armature(plain, tmp_path / "scaled.glb")]
    with streaming(tmp_path / "t.npz") as address:
        told = run_reader(
            python, "blender_extension.py", extension, tmp_path / "t.npz", out, address, *characters
        )
    assert told["people"] == 3
    assert told["drawn"] == PANEL
    with np.load(out) as found:
        tracked_first = take.tracked[0]
        for row, name in enumerate(take.subject_names):
            names = found[f"names_{name}"].tolist()
            assert {"left_pelvis", "left_clavicle"} <= {*names}
            tracked = take.tracked[row]
            live = found[f"live_{name}"]
            assert len(live) > 60
            for bone, bone_name in enumerate(take.bone_names):
                true = take.bone_position_in_world_m[row, tracked, bone]
                at = names.index(bone_name)
                assert np.abs(found[f"import_{name}"][tracked, at] - true).max() < NEAR_M
            # Of the stream, whatever instant each frame is: a pose of the take, or between two.
            all_true = take.bone_position_in_world_m[row, tracked]
            order = [names.index(n) for n in take.bone_names]
            apart = np.abs(live[:, None, order] - all_true[None]).max(axis=(2, 3)).min(axis=1)
            assert np.median(apart) < 0.02
        for number, character in enumerate(characters):
            fusecap.retarget(take, character, tmp_path / "r.glb", subject=take.subject_names[0])
            expected = world_of(tmp_path / "r.glb", len(take.timestamps_ns))
            names = found[f"character_names_{number}"].tolist()
            for at, name in enumerate(names):
                away = np.abs(found[f"character_{number}"][:, at] - expected[name])[tracked_first]
                assert away.max() < NEAR_M, name
        moved = np.ptp(found["live_character"], axis=0).max(axis=1)
        assert len(found["live_character"]) > 60 and moved.max() > 0.1
