"""`fusecap report`: a page about a take, with and without the session it was solved from."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from fusecap.batch.report_page import report_page
from fusecap.batch.seen import look_back
from fusecap.batch.solved_inputs import inputs_beside, open_solved_inputs
from fusecap.body.skeleton import EXTENDED23
from fusecap.cli import app
from fusecap.cli.common import Exports, write_take
from fusecap.errors import TakeError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.stored_take import load_take
from fusecap.take import save_take
from motions import person, solved, take_of, walk

SECONDS = 1.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A second of the demo as a session, its true take beside it as if it had been solved."""
    folder = tmp_path_factory.mktemp("scene")
    simulation = demo_scene(0, seconds=SECONDS)
    write_session(simulation, folder)
    inputs = open_solved_inputs(folder)
    told = {**simulation.truth.provenance, "session_sha256": inputs.sha256}
    save_take(replace(simulation.truth, provenance=told), folder / "demo.npz")
    return folder


@pytest.fixture(scope="module")
def seen(scene):
    take, inputs = load_take(scene / "demo.npz"), open_solved_inputs(scene)
    return look_back(take, inputs.setup, inputs.instants)


def run(*arguments: object):
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def page_of(take, **options) -> str:
    return report_page(take, "take", seen=None, **options)


def test_everybody_is_found_where_cameras_saw_them(seen):
    assert seen.cameras == ("cam1", "cam2", "cam3", "cam4") and seen.every == 1
    assert (seen.keypoints > 0).mean() > 0.9
    assert all(2 < camera["median"] < 8 for camera in seen.reprojection_px.values())
    assert np.nanmax(seen.residual_px) < 40  # nobody is taken for another
    assert seen.others.max() == 1  # the bystander


def test_who_is_not_in_the_take_counts_among_the_others(scene, seen):
    take, inputs = load_take(scene / "demo.npz"), open_solved_inputs(scene)
    alone = look_back(take.of_subjects([1]), inputs.setup, inputs.instants)
    np.testing.assert_array_equal(alone.keypoints[0], seen.keypoints[1])
    np.testing.assert_array_equal(alone.others, seen.others + (seen.keypoints[0] > 0))
    assert {sensor.subject for sensor in alone.sensors} == {"ben"}


def test_a_turned_sensor_is_seen_and_no_other(scene, seen):
    inputs = open_solved_inputs(scene)
    anna = inputs.setup.subjects[0]
    turned = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    readings = inputs.instants.readings

    class Turned:
        __len__ = inputs.instants.__len__
        detections = inputs.instants.detections

        def readings(self, instant):
            found = dict(readings(instant))
            rotation = found["anna"].bone_rotation_in_world.copy()
            rotation[2] = rotation[2] @ turned
            found["anna"] = replace(found["anna"], bone_rotation_in_world=rotation)
            return found

    again = look_back(load_take(scene / "demo.npz"), inputs.setup, Turned())
    for index, (now, before) in enumerate(zip(again.sensors, seen.sensors, strict=True)):
        moved = abs(np.nanmedian(now.off_deg) - np.nanmedian(before.off_deg))
        assert (moved > 15) == (index == 2), now.bone
    assert again.sensors[2].subject == anna.name


def test_a_take_of_another_time_or_skeleton_is_refused(scene):
    take, inputs = load_take(scene / "demo.npz"), open_solved_inputs(scene)
    later = replace(take, timestamps_ns=take.timestamps_ns + 10**12)
    with pytest.raises(TakeError, match="share no instant"):
        look_back(later, inputs.setup, inputs.instants)
    shape = person(1.75, EXTENDED23)
    other = take_of(walk(shape, 3)[None], [shape], names=("anna",))
    with pytest.raises(TakeError, match=r"extended23.*paper21"):
        look_back(other, inputs.setup, inputs.instants)


def test_the_page_has_all_sections_and_reaches_for_nothing(scene, tmp_path):
    out = tmp_path / "page.html"
    result = run(scene / "demo.npz", "--out", out)
    assert result.exit_code == 0, result.output
    page = out.read_text()
    for section in (
        *("People", "Who was seen when, by what", "Cameras", "How sure the poses are"),
        *("Sensors against poses", "Feet on the floor", "The solve"),
    ):
        assert f"<h2>{section}</h2>" in page
    assert "Simulated." in page
    assert not re.search(r"<script|<link|src=|@import|url\(http", page)
    # Pictures are in the page, links within them point into it.
    assert all(where.startswith(("#", "data:")) for where in re.findall(r'href="([^"]*)', page))


def test_a_solve_leaves_its_report_in_the_take(scene, tmp_path):
    cameras = {"cam1": {"median": 5.0, "p90": float("nan"), "keypoints": 7}}
    told = solved(load_take(scene / "demo.npz"), reprojection_px=cameras, notes=("a sensor slept",))
    (path,) = write_take(told, tmp_path / "solved.npz", Exports(formats=[]), picture=False)
    page = page_of(load_take(path))
    for text in ("As the solve told them", "converged 120", "1.25", "a sensor slept"):
        assert text in page


def test_without_its_session_the_page_says_what_is_missing(scene, tmp_path):
    take = load_take(scene / "demo.npz")
    save_take(take, tmp_path / "away.npz")
    result = run(tmp_path / "away.npz", "--json")
    assert result.exit_code == 0, result.output
    assert "does not stand beside" in json.loads(result.stdout)["notes"][0]
    assert "name it with --session" in (tmp_path / "away_report.html").read_text()
    assert run(tmp_path / "away.npz", "--session", scene).exit_code == 0
    assert "<h2>Cameras</h2>" in (tmp_path / "away_report.html").read_text()


def test_a_session_that_was_changed_is_not_taken_for_the_one_solved(scene, tmp_path):
    take = load_take(scene / "demo.npz")
    shutil.copytree(scene, tmp_path, dirs_exist_ok=True)
    with (tmp_path / "session.toml").open("a") as file:
        file.write("# changed\n")
    found, why = inputs_beside(tmp_path / "demo.npz", take)
    assert found is None and "not as it was solved" in why
    result = run(tmp_path / "demo.npz", "--session", tmp_path, "--json")
    assert "no longer" in json.loads(result.stdout)["notes"][0]


def test_view_shows_cameras_of_the_session_a_take_was_solved_from_alone(
    scene, tmp_path, monkeypatch
):
    shown = []
    module = sys.modules["fusecap.cli.view"]

    def look(take, *_, rig, **__):
        take.close()
        shown.append(rig is not None)

    monkeypatch.setattr(module, "look", look)
    shutil.copytree(scene, tmp_path, dirs_exist_ok=True)
    assert CliRunner().invoke(app, ["view", str(tmp_path / "demo.npz")]).exit_code == 0
    with (tmp_path / "session.toml").open("a") as file:
        file.write("# changed\n")
    result = CliRunner().invoke(app, ["view", str(tmp_path / "demo.npz")])
    assert "not as it was solved" in " ".join(result.stderr.split())
    assert shown == [True, False]


def test_names_are_text_and_nothing_else():
    nasty = ("<script>alert(1)</script>", "$\\frac{1}$ & co", "\u4e2d\u6587")
    take = take_of(np.stack([walk(person(), 5)] * 3), [person()] * 3, names=nasty)
    page = page_of(take, notes=("<b>note</b>",))
    assert "<script>" not in page and "<b>note</b>" not in page
    assert "&lt;script&gt;" in page and "\\frac{1}$ &amp; co" in page


@pytest.mark.parametrize("frames", [1, 1500])
def test_takes_of_any_length_have_a_page_of_bounded_size(frames):
    take = take_of(walk(person(), frames)[None], [person()], names=("anna",))
    assert len(page_of(take)) < 400_000


def test_nobody_and_a_person_lying_are_no_fault():
    lying = walk(person(), 40)
    lying[:, 3] = np.pi / 2
    take = take_of(lying[None], [person()], names=("anna",))
    assert "100.0 %" in page_of(take)
    nobody = replace(take, tracked=np.zeros_like(take.tracked))
    assert "0.0 %" in page_of(nobody)
    assert "0 people" in page_of(take.of_subjects([]))


def test_bad_input_is_one_line(scene, tmp_path):
    take = load_take(scene / "demo.npz")
    save_take(take.of_frames(0, 0), tmp_path / "empty.npz")
    for arguments, expected in (
        ((tmp_path / "empty.npz",), "no frame"),
        ((scene / "demo.npz", "--out", tmp_path / "page.pdf"), ".html"),
        ((scene / "demo.npz", "--out", scene / "demo.npz" / "page.html"), "cannot write"),
        ((scene / "demo.npz", "--session", tmp_path / "nowhere"), "nowhere"),
    ):
        result = run(*arguments)
        assert result.exit_code != 0 and expected in str(result.exception), expected
