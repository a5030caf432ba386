import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from board_images import CHARUCO, CHECKERBOARD, camera, pose, rendered, seen, shots
from fusecap.calibrate.cameras import bundle_adjustment, extrinsics, extrinsics_checks
from fusecap.calibrate.cameras.board import Board
from fusecap.calibrate.cameras.board_views import read_shots, read_timestamps
from fusecap.calibrate.cameras.bundle_adjustment import adjust, residuals_px, stack_views
from fusecap.calibrate.cameras.intrinsics import calibrate_intrinsics
from fusecap.calibrate.cameras.report import calibrate_rig
from fusecap.cli import main
from fusecap.errors import CalibrationError
from fusecap.geometry.projection_derivatives import PARAMETERS, moved
from fusecap.geometry.similarity import fitted_similarity
from fusecap.sources.calibration_files import load_rig

DISTORTED = (-0.2, 0.05, 0.0, 0.0, 0.0)
NOISE_PX, LENS_NOISE_PX = 0.2, 0.15


def board_poses(count, rng, *, tilt_deg=35.0, spread=0.35, depth=(0.6, 1.3)):
    """cam_from_board all over the image."""
    for _ in range(count):
        z = rng.uniform(*depth)
        place = (z * rng.uniform(-spread, spread), z * rng.uniform(-spread, spread), z)
        yield pose(rng.uniform(-tilt_deg, tilt_deg, 3), place)


def lens_shots(lens, rng, count=30, noise_px=LENS_NOISE_PX, **poses):
    views = {
        i: seen(CHARUCO, lens, p, noise_px=noise_px, rng=rng)
        for i, p in enumerate(board_poses(count, rng, **poses))
    }
    return shots(lens, views)


def ring(count=4, *, distortion=(0, 0, 0, 0, 0)):
    """Cameras on a quarter circle of 2 m around the origin, looking at it."""
    cameras = []
    for index in range(count):
        place = np.eye(4)
        place[:3, :3] = Rotation.from_euler("yx", [25.0 * index, 8.0], degrees=True).as_matrix()
        place[:3, 3] = [0, 0, 2.0]
        cameras.append(
            camera(f"c{index}", focal=900.0, size=(1280, 960), distortion=distortion, pose=place)
        )
    return cameras


def rig_shots(cameras, rng, instants=30, noise_px=NOISE_PX):
    """A board carried about the origin."""
    found = []
    turns = rng.uniform(-30, 30, (instants, 3))
    places = rng.uniform(-0.35, 0.35, (instants, 3))
    boards = {i: pose(turns[i], places[i]) for i in range(instants)}
    for lens in cameras:
        views = {i: seen(CHARUCO, lens, b, noise_px=noise_px, rng=rng) for i, b in boards.items()}
        found.append(shots(lens, views))
    return found


def relative(cameras):
    """Centres [m] and turns in the first camera's frame."""
    first = cameras[0]
    centres = [first.rotation @ c.position_in_world + first.translation for c in cameras]
    return np.array(centres), [c.rotation @ first.rotation.T for c in cameras]


def test_gradients_of_the_bundle_adjustment_are_those_of_finite_differences(rng):
    cameras = [replace(c, distortion=np.array([-0.1, 0.02, 1e-3, -2e-3, 0.01])) for c in ring(2)]
    boards = np.stack([pose((10, 20, 5), (0.1, 0, 0)), pose((-15, 5, 40), (0, 0.1, 0.2))])
    views = [
        (c, b, seen(CHARUCO, lens, boards[b], noise_px=3.0, rng=rng))
        for c, lens in enumerate(cameras)
        for b in range(2)
    ]
    corners = stack_views(views, CHARUCO.corners_in_board_m)
    free = np.ones((2, PARAMETERS), dtype=bool)
    for robust_px in (np.inf, 2.0):
        normal = bundle_adjustment._linearise(cameras, boards, corners, free, robust_px)

        def cost(some_cameras, some_boards, robust_px=robust_px):
            return bundle_adjustment._linearise(
                some_cameras, some_boards, corners, free, robust_px
            ).cost

        slopes = []
        for index in range(2 * PARAMETERS):
            step = np.zeros((2, PARAMETERS))
            step.ravel()[index] = h = 1e-6
            ahead, back = (
                cost([moved(c, s) for c, s in zip(cameras, sign * step, strict=True)], boards)
                for sign in (1, -1)
            )
            slopes.append((ahead - back) / (4 * h))
        np.testing.assert_allclose(normal.camera_gradient, slopes, rtol=2e-4, atol=1e-2)
        slopes = np.zeros((2, 6))
        for index in range(12):
            step = np.zeros((2, 6))
            step.ravel()[index] = h = 1e-7
            ahead, back = (
                cost(cameras, bundle_adjustment._moved_boards(boards, sign * step))
                for sign in (1, -1)
            )
            slopes.ravel()[index] = (ahead - back) / (4 * h)
        np.testing.assert_allclose(normal.board_gradients, slopes, rtol=2e-4, atol=1e-1)


def test_bundle_adjustment_returns_to_the_truth_and_keeps_what_is_not_free(rng):
    cameras = ring(3, distortion=DISTORTED)
    boards = np.stack([pose(rng.uniform(-30, 30, 3), rng.uniform(-0.3, 0.3, 3)) for _ in range(8)])
    views = [
        (c, b, seen(CHARUCO, lens, boards[b])) for c, lens in enumerate(cameras) for b in range(8)
    ]
    corners = stack_views(views, CHARUCO.corners_in_board_m)
    free = np.zeros((3, PARAMETERS), dtype=bool)
    free[1:, :6] = True
    start = [cameras[0]] + [
        moved(c, np.r_[rng.normal(0, 0.02, 6), np.zeros(9)]) for c in cameras[1:]
    ]
    found = adjust(start, boards, corners, free=free)
    assert found.converged
    assert np.abs(residuals_px(found.cameras, found.boards, corners)).max() < 1e-4
    np.testing.assert_array_equal(found.cameras[1].matrix, cameras[1].matrix)
    np.testing.assert_array_equal(found.cameras[0].translation, cameras[0].translation)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distortion", "model"), [((0, 0, 0, 0, 0), "none"), ((-0.25, 0, 0, 0, 0), "k1")]
)
def test_the_lens_is_recovered_with_no_more_coefficients_than_it_has(rng, distortion, model):
    truth = camera(focal=600.0, distortion=distortion)
    found = calibrate_intrinsics(lens_shots(truth, rng), CHARUCO)
    assert found.model == model
    np.testing.assert_allclose(found.camera.matrix, truth.matrix, atol=3.0)
    np.testing.assert_allclose(found.camera.distortion, truth.distortion, atol=0.02)
    assert found.held_out_px == pytest.approx(LENS_NOISE_PX * np.sqrt(2), rel=0.2)
    assert found.verdict == "good", found.advice
    assert abs(found.camera.matrix[0, 0] - 600.0) < 4 * found.focal_spread_px


@pytest.mark.slow
def test_an_image_of_a_bent_board_is_left_out_by_name(rng):
    lens = camera()
    found = lens_shots(lens, rng)
    views = list(found.shots)
    bent = views[3].view.pixels + rng.normal(0, 12, views[3].view.pixels.shape)
    views[3] = replace(views[3], view=replace(views[3].view, pixels=bent))
    lens_found = calibrate_intrinsics(replace(found, shots=tuple(views)), CHARUCO, model="none")
    assert [image.label for image in lens_found.images if image.left_out] == [views[3].label]
    assert lens_found.camera.matrix[0, 0] == pytest.approx(600.0, abs=3.0)


@pytest.mark.slow
def test_boards_that_all_face_the_camera_are_a_poor_calibration(rng):
    found = calibrate_intrinsics(lens_shots(camera(), rng, tilt_deg=2.0), CHARUCO, model="none")
    assert found.verdict == "poor"
    assert any("tilt the board" in remedy for remedy in found.advice)


@pytest.mark.slow
def test_an_edge_that_the_board_never_reached_is_named(rng):
    shown = lens_shots(camera(), rng, count=40)
    right = [shot for shot in shown.shots if shot.view.pixels[:, 0].min() > 220]
    found = calibrate_intrinsics(replace(shown, shots=tuple(right)), CHARUCO, model="none")
    assert any("near the left" in remedy for remedy in found.advice)


def test_three_images_are_too_few(rng):
    with pytest.raises(CalibrationError, match="board is in 3 of 3 images; expected at least 4"):
        calibrate_intrinsics(lens_shots(camera(), rng, count=3, spread=0.1), CHARUCO)


@pytest.mark.slow
def test_cameras_are_placed_to_a_millimetre(rng):
    truth = ring(distortion=DISTORTED)
    found = calibrate_rig(truth, rig_shots(truth, rng), CHARUCO)
    centres, turns = relative(truth)
    got, got_turns = relative(found.solution.cameras)
    assert np.linalg.norm(got - centres, axis=1).max() < 2e-3
    for a, b in zip(turns, got_turns, strict=True):
        assert np.degrees(Rotation.from_matrix(a @ b.T).magnitude()) < 0.1
    report = found.report
    assert report.verdict in ("good", "usable")
    assert report.held_out_px == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.15)
    assert report.predicted_median_px < 1.0
    assert report.scale.mean == pytest.approx(1.0, abs=1e-3)
    assert 0 < max(row.centre_spread_mm for row in report.cameras) < 4


@pytest.mark.slow
def test_a_view_of_another_instant_is_left_out_by_name(rng):
    truth = ring()
    found = rig_shots(truth, rng)
    moved_on = list(found[1].shots)
    moved_on[4] = replace(moved_on[4], view=moved_on[5].view)
    found[1] = replace(found[1], shots=tuple(moved_on))
    solution = extrinsics.solve(truth, extrinsics.views_of(found), CHARUCO)
    assert solution.left_out == ((1, moved_on[4].instant),)


@pytest.mark.slow
def test_refining_finds_a_focal_length_that_was_stated_wrong(rng):
    truth = ring()
    stated = [moved(c, np.r_[np.zeros(6), 15.0, 15.0, np.zeros(7)]) for c in truth]
    views = extrinsics.views_of(rig_shots(truth, rng))
    solution = extrinsics.solve(stated, views, CHARUCO, refine_intrinsics=True)
    focal = [c.matrix[0, 0] for c in solution.cameras]
    np.testing.assert_allclose(focal, 900.0, atol=5.0)


def test_a_camera_that_shares_no_board_is_named(rng):
    truth = ring(3)
    found = rig_shots(truth, rng)
    later = tuple(replace(shot, instant=shot.instant + 1000) for shot in found[2].shots)
    found[2] = replace(found[2], shots=later)
    with pytest.raises(CalibrationError, match=r"'c2' and 'c0', 'c1' see the board together"):
        calibrate_rig(truth, found, CHARUCO)


def test_a_board_that_is_too_small_to_be_found_is_said_to_be(rng):
    truth = ring(2)
    found = [replace(shots, shots=shots.shots[:1]) for shots in rig_shots(truth, rng)]
    with pytest.raises(CalibrationError, match=r"found in 1 of 'c0', 1 of 'c1' images.*larger"):
        calibrate_rig(truth, found, CHARUCO)


def test_a_checkerboard_that_half_a_turn_does_not_change_is_refused(rng):
    truth = ring(2)
    with pytest.raises(CalibrationError, match="half a turn"):
        calibrate_rig(truth, rig_shots(truth, rng), replace(CHECKERBOARD, columns=8))


def test_intrinsics_of_another_image_size_are_refused(rng):
    truth = ring(2)
    found = rig_shots(truth, rng)
    with pytest.raises(CalibrationError, match="in the mode that records"):
        calibrate_rig([replace(c, size_px=(640, 480)) for c in truth], found, CHARUCO)


@pytest.fixture
def recording(tmp_path, rng):
    """Images of two cameras, a board file, and the true rig."""
    cameras = [
        camera(n, focal=700.0, size=(480, 360), pose=place)
        for n, place in (("left", np.eye(4)), ("right", np.eye(4)))
    ]
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("y", 25, degrees=True).as_matrix()
    turned[:3, 3] = [-0.5, 0.02, 0.12]
    cameras[1] = replace(cameras[1], rotation=turned[:3, :3], translation=turned[:3, 3])
    for instant in range(10):
        there = pose(rng.uniform(-25, 25, 3), (*rng.uniform(-0.1, 0.1, 2), 1.1 + 0.05 * instant))
        for lens in cameras:
            cam_from_world = np.eye(4)
            cam_from_world[:3, :3], cam_from_world[:3, 3] = lens.rotation, lens.translation
            folder = tmp_path / lens.name
            folder.mkdir(exist_ok=True)
            picture = rendered(CHARUCO, lens, cam_from_world @ there, noise=1.0, seed=instant)
            cv2.imwrite(str(folder / f"f{instant:03d}.png"), picture)
    (tmp_path / "board.toml").write_text(
        'kind = "charuco"\ncolumns = 5\nrows = 6\nsquare_m = 0.06\nmarker_m = 0.045\n'
        'dictionary = "DICT_4X4_100"\n'
    )
    return tmp_path, cameras


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", *map(str, arguments)])
    try:
        main()
    except SystemExit as stop:
        return stop.code or 0
    return 0


@pytest.mark.slow
def test_the_commands_go_from_images_to_a_calibration(recording, monkeypatch, capsys):
    folder, truth = recording
    sources = [f"{c.name}={folder / c.name}" for c in truth]
    common = [*sources, "--board", folder / "board.toml", "--json"]
    assert run(monkeypatch, "intrinsics", *common, "--out", folder / "lenses.toml") == 0
    lenses = json.loads(capsys.readouterr().out)
    assert [c["name"] for c in lenses["cameras"]] == ["left", "right"]
    assert lenses["cameras"][0]["verdict"] in ("usable", "poor")
    assert lenses["cameras"][0]["advice"]
    common += ["--intrinsics", folder / "lenses.toml", "--out", folder / "rig.toml"]
    assert run(monkeypatch, "extrinsics", *common, "--origin-frame", 0) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["instants"] == 10
    for name in report["files"]:
        assert (folder / name).stat().st_size > 100
    rig = load_rig(folder / "rig.toml")
    apart = np.linalg.norm(np.subtract(*(c.position_in_world for c in rig.cameras)))
    true = np.linalg.norm(np.subtract(*(c.position_in_world for c in truth)))
    assert apart == pytest.approx(true, rel=0.03)
    assert all(c.position_in_world[1] > 0.5 for c in rig.cameras), "above the floor"


@pytest.mark.slow
def test_the_commands_fail_in_one_line(recording, monkeypatch, capsys):
    folder, _ = recording
    board = folder / "board.toml"
    source = f"left={folder / 'left'}"
    assert run(monkeypatch, "extrinsics", source, "--board", board) == 2
    assert run(monkeypatch, "intrinsics", "left", "--board", board) == 2
    assert run(monkeypatch, "extrinsics") == 2
    capsys.readouterr()
    out = folder / "none.toml"
    missing = f"left={folder / 'left' / 'f001.png'}"
    assert run(monkeypatch, "intrinsics", missing, "--board", board, "--out", out) == 1
    assert "expected at least 4" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.real_data
def test_a_real_rig_agrees_with_its_reference_calibration(data_dir):
    folder = data_dir / "caliscope" / "post_optimization"
    board = Board(
        kind="charuco",
        columns=4,
        rows=5,
        square_m=0.054,
        marker_m=0.0405,
        dictionary="DICT_4X4_1000",
        inverted=True,
    )
    reference = load_rig(folder / "camera_array.toml").cameras
    videos = folder / "calibration" / "extrinsic"
    sync = read_timestamps(videos / "timestamps.csv")
    found = [
        read_shots(c.name, videos / f"cam_{i}.mp4", board, sync=sync[str(i)])
        for i, c in enumerate(reference)
    ]
    shown = {(c, shot.instant): shot.view for c, cam in enumerate(found) for shot in cam.shots}
    away = []
    with (videos / "xy.csv").open() as file:
        for row in csv.DictReader(file):
            view = shown.get((int(row["cam_id"]), int(row["sync_index"])))
            if view is not None:
                mine = view.pixels[view.corner_ids == int(row["keypoint_id"])]
                there = float(row["img_loc_x"]), float(row["img_loc_y"])
                away += np.linalg.norm(mine - there, axis=1).tolist()
    assert len(away) > 1900 and np.median(away) < 0.6
    views = extrinsics.views_of(found)
    solution = extrinsics.solve(reference, views, board)
    ours, theirs = (
        np.array([c.position_in_world for c in cameras])
        for cameras in (solution.cameras, reference)
    )
    onto = fitted_similarity(ours, theirs)
    size = np.linalg.norm(theirs[:, None] - theirs[None], axis=2).max()
    assert np.linalg.norm(onto.points(ours) - theirs, axis=1).max() < 0.01 * size

    def rms(cameras):
        miss = np.concatenate(
            [v.fitted_px for v in extrinsics_checks.predicted(cameras, views, board)]
        )
        return np.sqrt((miss**2).mean())

    assert rms(solution.cameras) < 1.1 * rms(reference)
