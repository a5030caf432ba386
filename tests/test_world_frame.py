import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.board_drawing import board_toml, draw_png, page_for
from fusecap.calibrate.cameras.resting_imu import resting_imu
from fusecap.calibrate.cameras.world_frame import (
    from_board,
    from_floor_points,
    from_gravity,
    from_points,
    known_length,
    to_north,
    to_reference,
)
from fusecap.cli import main
from fusecap.errors import CalibrationError, InputError
from fusecap.geometry.camera import Rig
from fusecap.geometry.similarity import Similarity
from fusecap.sources.calibration_files import load_rig, write_rig
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.marked_points import MarkedPoints, read_marked_points
from session_files import camera_at, imu_csv, ring

TRUE = ring(4)
"""The cameras in the world that is to be found."""
MOVED = Similarity(
    rotation=Rotation.from_rotvec([0.7, -0.4, 1.9]).as_matrix(),
    translation_m=np.array([0.4, -1.2, 3.0]),
)
BOARD = Board(
    kind="charuco", columns=7, rows=5, square_m=0.06, marker_m=0.045, dictionary="DICT_5X5_50"
)
PLACES = np.array([[0, 0, 0], [1.2, 0, 0.1], [-0.3, 0.8, 0.9], [0.5, 1.5, -0.8], [-1, 0.2, -0.6]])
FLOOR = np.array([[0, 0, 0], [1.2, 0, 0.1], [-0.3, 0, 0.9], [0.5, 0, -0.8], [-1, 0, -0.6]])
NAMES = ("a", "b", "c", "d", "e")


def assert_same_cameras(rig: Rig, expected: Rig, atol: float = 1e-6) -> None:
    for camera in expected.cameras:
        assert np.allclose(rig[camera.name].position_in_world, camera.position_in_world, atol=atol)
        assert np.allclose(rig[camera.name].rotation, camera.rotation, atol=atol)


def board_views(rig: Rig, cameras, *, height_m=0.0, noise_px=0.0, seed=0, lying=None):
    """The board face up with its first corner over the origin: x along x, rows along z."""
    rng = np.random.default_rng(seed)
    world_from_board = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    if lying is not None:
        world_from_board = lying @ world_from_board
    corners = BOARD.corners_in_board_m @ world_from_board.T + [0, height_m, 0]
    views = {}
    for name in cameras:
        pixels = rig[name].project(corners)
        noise = noise_px * rng.standard_normal(pixels.shape)
        views[name] = BoardView(corner_ids=np.arange(len(corners)), pixels=pixels + noise)
    return views


def marks(rig: Rig, places: np.ndarray, *, told=None, noise_px=0.0, names=NAMES) -> MarkedPoints:
    rng = np.random.default_rng(3)
    keypoints = np.ones((len(rig), len(places), 3))
    for index, camera in enumerate(rig.cameras):
        pixels = camera.project(places.astype(float))
        keypoints[index, :, :2] = pixels + noise_px * rng.standard_normal(pixels.shape)
    return MarkedPoints(names=names[: len(places)], keypoints=keypoints, in_world_m=told)


def at_rest(attitude: Rotation, *, noise_m_s2=0.02, samples=200) -> ImuTrack:
    """A sensor with this orientation in a z-up reference world."""
    wxyz = np.roll(attitude.as_quat(), 1)
    accel = attitude.inv().apply([0, 0, 9.80665])
    noise = noise_m_s2 * np.random.default_rng(1).standard_normal((samples, 3))
    return ImuTrack(
        times_s=np.arange(samples) / 100,
        orientation_wxyz=np.tile(wxyz, (samples, 1)),
        accel_m_s2=accel + noise,
    )


vectors = st.tuples(*[st.floats(-3, 3)] * 3)


@given(vectors, vectors, st.floats(0.2, 5), vectors)
def test_cameras_see_the_same_after_the_world_changed(turn, shift, scale, point):
    change = Similarity(
        rotation=Rotation.from_rotvec(turn).as_matrix(), translation_m=np.array(shift), scale=scale
    )
    points = np.array([point, [0.0, 1.0, 0.0]])
    for before, after in zip(TRUE.cameras, change.rig(TRUE).cameras, strict=True):
        assert np.allclose(
            before.project(points), after.project(change.points(points)), atol=1e-6, equal_nan=True
        )


def test_changes_follow_each_other():
    second = Similarity(rotation=MOVED.rotation.T, translation_m=np.ones(3), scale=2.0)
    assert_same_cameras(second.after(MOVED).rig(TRUE), second.rig(MOVED.rig(TRUE)), 1e-12)


@pytest.mark.parametrize("cameras", [["cam0"], ["cam0", "cam2"], list(TRUE.names)])
def test_board_on_the_floor_gives_the_world_back(cameras):
    placement = from_board(MOVED.rig(TRUE), BOARD, board_views(TRUE, cameras))
    assert_same_cameras(placement.change.rig(MOVED.rig(TRUE)), TRUE, 1e-5)
    assert placement.rms_px == pytest.approx(0, abs=1e-4)


def test_thick_board_lies_above_the_floor():
    views = board_views(TRUE, ["cam0", "cam1"], height_m=0.02)
    placement = from_board(MOVED.rig(TRUE), BOARD, views, thickness_m=0.02)
    assert_same_cameras(placement.change.rig(MOVED.rig(TRUE)), TRUE, 1e-5)


def test_stated_tilt_is_the_tilt_that_noise_makes():
    tilts, stated = [], []
    for seed in range(12):
        views = board_views(TRUE, ["cam0", "cam1"], noise_px=0.3, seed=seed)
        placement = from_board(TRUE, BOARD, views)
        up = placement.change.rotation[:, 1]
        tilts.append(np.degrees(np.arccos(up[1])))
        stated.append(placement.tilt_deg)
    per_axis = np.sqrt(np.mean(np.square(tilts)) / 2)
    assert 0.5 * per_axis < np.median(stated) < 2.0 * per_axis


def test_board_tells_the_scale_of_a_calibration():
    small = Similarity(scale=0.8).rig(MOVED.rig(TRUE))
    views = board_views(TRUE, ["cam0", "cam1", "cam2"])
    placement = from_board(small, BOARD, views)
    assert placement.found_scale == pytest.approx(1.25, abs=1e-4)
    assert any("--scale-by board" in problem for problem in placement.problems)
    placement = from_board(small, BOARD, views, scale=True)
    assert_same_cameras(placement.change.rig(small), TRUE, 1e-4)


def test_one_view_of_a_board_cannot_tell_scale():
    with pytest.raises(CalibrationError, match="two or more"):
        from_board(TRUE, BOARD, board_views(TRUE, ["cam0"]), scale=True)


def test_checkerboard_that_looks_the_same_after_half_a_turn_still_fits():
    board = Board(kind="checkerboard", columns=8, rows=6, square_m=0.06)
    corners = board.corners_in_board_m @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    ids = np.arange(len(corners))
    views = {
        name: BoardView(corner_ids=ids, pixels=TRUE[name].project(corners)[:: -1 if flip else 1])
        for name, flip in (("cam0", False), ("cam1", True), ("cam2", True))
    }
    placement = from_board(MOVED.rig(TRUE), board, views)
    assert placement.rms_px == pytest.approx(0, abs=1e-3)
    heights = [c.position_in_world[1] for c in placement.change.rig(MOVED.rig(TRUE)).cameras]
    assert np.allclose(heights, 2.0, atol=1e-4)


def test_board_that_moved_between_the_images_is_called_poor():
    views = board_views(TRUE, ["cam0"]) | board_views(TRUE, ["cam1"], height_m=0.1)
    placement = from_board(TRUE, BOARD, views)
    assert any("did not move between the images" in problem for problem in placement.problems)


@pytest.mark.parametrize("scale", [False, True])
def test_marked_points_give_the_world_back(scale):
    old = Similarity(scale=0.7).rig(MOVED.rig(TRUE)) if scale else MOVED.rig(TRUE)
    placement = from_points(old, marks(TRUE, PLACES, told=PLACES), scale=scale)
    assert_same_cameras(placement.change.rig(old), TRUE, 1e-4)
    assert placement.rms_mm < 0.1
    assert placement.problems == ()


def test_point_at_a_wrong_place_is_named_and_left_out():
    told = PLACES.copy()
    told[2, 0] += 0.3
    placement = from_points(MOVED.rig(TRUE), marks(TRUE, PLACES, told=told, noise_px=0.5))
    assert [r.name for r in placement.residuals if not r.used] == ["c"]
    assert any(problem.startswith("'c' is ") for problem in placement.problems)
    assert_same_cameras(placement.change.rig(MOVED.rig(TRUE)), TRUE, 0.02)


def test_noise_alone_makes_no_outlier():
    for seed in range(20):
        told = PLACES + 0.003 * np.random.default_rng(seed).standard_normal(PLACES.shape)
        placement = from_points(MOVED.rig(TRUE), marks(TRUE, PLACES, told=told, noise_px=1.0))
        assert all(residual.used for residual in placement.residuals)


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        (PLACES[:2], "2 of 2 points"),
        (np.linspace([0, 0, 0], [1, 0.5, 1], 4), "on a line"),
    ],
)
def test_too_few_points_or_points_on_a_line_are_refused(places, expected):
    with pytest.raises(InputError, match=expected):
        from_points(TRUE, marks(TRUE, places, told=places))


def test_point_in_one_camera_is_named_as_unused():
    points = marks(TRUE, PLACES, told=PLACES)
    points.keypoints[1:, 4] = [np.nan, np.nan, 0.0]
    placement = from_points(MOVED.rig(TRUE), points)
    assert placement.residuals[-1].name == "e"
    assert not placement.residuals[-1].used


def test_points_on_the_floor_level_the_cameras_and_turn_them_no_farther():
    tilted = Similarity(
        rotation=Rotation.from_rotvec([0.2, 0.0, -0.1]).as_matrix(),
        translation_m=np.array([0.0, 0.7, 0.0]),
    )
    placement = from_floor_points(tilted.rig(TRUE), marks(TRUE, FLOOR))
    result = placement.change.rig(tilted.rig(TRUE))
    heights = [camera.position_in_world[1] for camera in result.cameras]
    assert np.allclose(heights, 2.0, atol=1e-4)
    assert placement.change.angle_deg == pytest.approx(np.degrees(np.hypot(0.2, 0.1)), abs=0.01)


def test_three_points_on_the_floor_are_called_unchecked():
    placement = from_floor_points(TRUE, marks(TRUE, FLOOR[:3]))
    assert any("nothing checks them" in problem for problem in placement.problems)


def test_point_off_the_floor_is_named():
    places = FLOOR.astype(float)
    places[3, 1] = 0.25
    placement = from_floor_points(MOVED.rig(TRUE), marks(TRUE, places))
    assert [r.name for r in placement.residuals if not r.used] == ["d"]


def test_gravity_and_one_point_make_a_floor():
    old = MOVED.rig(TRUE)
    up = MOVED.rotation @ [0.0, 1.0, 0.0]
    placement = from_floor_points(old, marks(TRUE, FLOOR[:1]), up_in_old=up)
    heights = [camera.position_in_world[1] for camera in placement.change.rig(old).cameras]
    assert np.allclose(heights, 2.0, atol=1e-4)


def test_imu_on_a_camera_says_what_is_up():
    camera = MOVED.rig(TRUE)["cam1"]
    # Sensor x to the image's right, y to its top, z out of the back.
    cam_from_imu = np.diag([1.0, -1.0, -1.0])
    z_up_from_y_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    attitude = Rotation.from_matrix(z_up_from_y_up @ TRUE["cam1"].rotation.T @ cam_from_imu)
    imu = resting_imu(at_rest(attitude), axes="right,up")
    assert imu.contradiction_deg < 0.1
    placement = from_gravity(camera.rotation.T @ imu.up_in_body)
    placed = placement.change.rig(MOVED.rig(TRUE))
    for name in TRUE.names:
        assert np.allclose(placed[name].rotation[:, 1], TRUE[name].rotation[:, 1], atol=0.002)
    turn = to_reference(imu.reference_from_body, placed["cam1"].rotation.T)
    assert np.allclose(turn.rig(placed)["cam2"].rotation, TRUE["cam2"].rotation, atol=0.003)


def test_imu_on_a_board_levels_a_sloping_floor():
    slope = Rotation.from_rotvec([0.03, 0.0, 0.02])
    views = board_views(TRUE, ["cam0", "cam1"], lying=slope.as_matrix())
    up_in_board = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ slope.inv().apply([0, 1, 0])
    placement = from_board(MOVED.rig(TRUE), BOARD, views, up_in_board=up_in_board)
    result = placement.change.rig(MOVED.rig(TRUE))
    heights = [camera.position_in_world[1] for camera in result.cameras]
    assert np.allclose(heights, 2.0, atol=1e-3)


@pytest.mark.parametrize(("reference", "north"), [("nwu", [1, 0, 0]), ("enu", [0, 0, -1])])
@pytest.mark.parametrize("bearing", [0.0, 90.0, 200.0])
def test_north_lies_where_the_reference_world_has_it(reference, north, bearing):
    away = -np.radians(bearing)
    before = np.array([np.cos(away), 0.0, np.sin(away)])
    assert np.allclose(to_north(bearing, reference).points(before), north, atol=1e-12)


def test_known_length_between_cameras_sets_the_scale():
    small = Similarity(scale=0.5).rig(TRUE)
    away = np.linalg.norm(TRUE["cam0"].position_in_world - TRUE["cam1"].position_in_world)
    assert known_length(small, "cam0", "cam1", float(away)).scale == pytest.approx(2.0)
    with pytest.raises(InputError, match="did you mean 'cam1'"):
        known_length(small, "cam0", "cam11", 1.0)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"noise_m_s2": 1.0}, "the sensor moved"),
        ({"samples": 5}, "5 samples"),
    ],
)
def test_unusable_imu_is_refused(change, expected):
    with pytest.raises(InputError, match=expected):
        resting_imu(at_rest(Rotation.identity(), **change), axes="right,up")


def test_imu_with_gravity_removed_is_refused():
    track = at_rest(Rotation.identity())
    free = ImuTrack(
        times_s=track.times_s,
        orientation_wxyz=track.orientation_wxyz,
        accel_m_s2=track.accel_m_s2 - [0, 0, 9.80665],
    )
    with pytest.raises(InputError, match="gravity must not be removed"):
        resting_imu(free, axes="right,up")


@pytest.mark.parametrize("axes", ["right", "right,left", "right,upp", "right,up,back"])
def test_unclear_sensor_axes_are_refused(axes):
    with pytest.raises(InputError, match="sensor axes"):
        resting_imu(at_rest(Rotation.identity()), axes=axes)


def write_marks(path, rig, places, told=True):
    header = ["name", *(["x_m", "y_m", "z_m"] if told else [])]
    header += [f"{name}_{axis}_px" for name in rig.names for axis in "uv"]
    lines = [",".join(header)]
    for name, place in zip(NAMES, places.astype(float), strict=True):
        pixels = [f"{v:.3f}" for c in rig.cameras for v in c.project(place[None])[0]]
        lines.append(",".join([name, *([f"{v:g}" for v in place] if told else []), *pixels]))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_marked_points_read_back(tmp_path):
    points = read_marked_points(write_marks(tmp_path / "p.csv", TRUE, PLACES), TRUE.names)
    assert points.names == NAMES
    assert np.allclose(points.in_world_m, PLACES)
    assert np.allclose(points.keypoints, marks(TRUE, PLACES).keypoints, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "expected a header"),
        ("point,x_m\na,1\n", "expected a header"),
        ("name,cam9_u_px\na,1\n", "unknown column 'cam9_u_px'; did you mean"),
        ("name,cam0_u_px\na,1\n", "but not cam0_v_px"),
        ("name,cam0_u_px,cam0_v_px\na,1,two\n", "'two', expected a number"),
        ("name,cam0_u_px,cam0_v_px\na,1,\n", "one of two pixel coordinates"),
        ("name,cam0_u_px,cam0_v_px\na,1,2\na,1,2\n", "a second 'a'"),
        ("name,cam0_u_px,cam0_v_px\na,1,2,3\n", "4 cells"),
        ("name,x_m,y_m,z_m\na,1,,2\n", "lacks one of"),
    ],
)
def test_broken_marks_are_refused(tmp_path, text, expected):
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=expected):
        read_marked_points(path, TRUE.names)


def run(monkeypatch, capsys, *arguments) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", "world", *map(str, arguments)])
    try:
        main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_command_writes_the_new_world(tmp_path, monkeypatch, capsys):
    old = write_rig(tmp_path / "old.toml", MOVED.rig(TRUE))[0]
    points = write_marks(tmp_path / "p.csv", TRUE, PLACES)
    out = tmp_path / "new.toml"
    code, text, errors = run(monkeypatch, capsys, old, "--points", points, "--out", out, "--json")
    assert code == 0, errors
    report = json.loads(text)
    assert report["problems"] == []
    assert report["rms_mm"] < 0.1
    assert report["camera_position_m"]["cam0"][1] == pytest.approx(2.0, abs=1e-4)
    assert_same_cameras(load_rig(out), TRUE, 1e-4)


def test_command_combines_gravity_floor_and_north(tmp_path, monkeypatch, capsys):
    old = write_rig(tmp_path / "old.toml", MOVED.rig(TRUE))[0]
    points = write_marks(tmp_path / "p.csv", TRUE, FLOOR, told=False)
    z_up_from_y_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    attitude = z_up_from_y_up @ TRUE["cam1"].rotation.T @ np.diag([1.0, -1.0, -1.0])
    wxyz = np.roll(Rotation.from_matrix(attitude).as_quat(), 1)
    imu = tmp_path / "imu.csv"
    imu.write_text(imu_csv(np.arange(100) / 100, np.tile(wxyz, (100, 1))))
    out = tmp_path / "new.toml"
    code, text, errors = run(
        monkeypatch, capsys, old, "--floor-points", points, "--gravity", f"cam1={imu}",
        "--north", "imu", "--out", out,
    )  # fmt: skip
    assert code == 0, errors
    assert "world: good" in text
    result = load_rig(out)
    assert np.allclose(result["cam3"].rotation, TRUE["cam3"].rotation, atol=1e-4)
    assert result["cam3"].position_in_world[1] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--points", "p", "--floor-points", "q"),
        ("--board", "b"),
        ("--floor-points", "p", "--north", "imu"),
        ("--floor-points", "p", "--north", "left"),
        ("--floor-points", "p", "--scale-by", "3m"),
        ("--floor-points", "p", "--board-thickness", "5"),
    ],
)
def test_contradicting_options_are_misuse(tmp_path, monkeypatch, capsys, arguments):
    old = write_rig(tmp_path / "old.toml", TRUE)[0]
    write_marks(tmp_path / "p", TRUE, FLOOR, told=False)
    arguments = [tmp_path / "p" if a == "p" else a for a in arguments]
    code, _, errors = run(monkeypatch, capsys, old, *arguments, "--out", tmp_path / "new.toml")
    assert code == 2, errors
    assert not (tmp_path / "new.toml").exists()


def test_cameras_below_the_floor_are_called_out(tmp_path, monkeypatch, capsys):
    flipped = Similarity(rotation=np.diag([1.0, -1.0, -1.0]))
    told = PLACES @ flipped.rotation.T
    old = write_rig(tmp_path / "old.toml", TRUE)[0]
    header = "name,x_m,y_m,z_m," + ",".join(f"{n}_{a}_px" for n in TRUE.names for a in "uv")
    lines = [header]
    for name, place, wanted in zip(NAMES, PLACES, told, strict=True):
        pixels = [v for c in TRUE.cameras for v in c.project(place[None].astype(float))[0]]
        lines.append(",".join([name, *(f"{v:.3f}" for v in (*wanted, *pixels))]))
    (tmp_path / "p.csv").write_text("\n".join(lines))
    code, _, errors = run(
        monkeypatch, capsys, old, "--points", tmp_path / "p.csv", "--out", tmp_path / "new.toml"
    )
    assert code == 0
    assert "below the floor" in errors


def photograph(rig: Rig, name: str, path) -> None:
    """What a camera sees of the board on a grey floor, its first corner over the origin."""
    page, dpi = page_for(BOARD), 50.0
    drawn = cv2.imdecode(
        np.frombuffer(draw_png(BOARD, page, dpi=dpi), np.uint8), cv2.IMREAD_GRAYSCALE
    )
    camera = rig[name]
    # Pixel of the drawing -> place on the floor -> pixel of the camera.
    metres = 0.0254 / dpi
    left, top = page.left_mm / 1e3, page.top_mm / 1e3
    floor_from_drawing = np.array(
        [[metres, 0, metres / 2 - left], [0, 0, 0], [0, metres, metres / 2 - top], [0, 0, 1]]
    )
    pose = np.column_stack([camera.rotation, camera.translation])
    image = cv2.warpPerspective(
        drawn,
        camera.matrix @ pose @ floor_from_drawing,
        camera.size_px,
        flags=cv2.INTER_LINEAR,
        borderValue=120,
    )
    cv2.imwrite(str(path), image)


def test_command_finds_the_board_in_images(tmp_path, monkeypatch, capsys):
    middle = (0.21, 0.0, 0.15)
    near = Rig(
        cameras=(
            camera_at("cam0", [-0.3, 0.8, 0.7], middle),
            camera_at("cam1", [0.8, 0.8, 0.6], middle),
        )
    )
    old = write_rig(tmp_path / "old.toml", MOVED.rig(near))[0]
    (tmp_path / "board.toml").write_text(board_toml(BOARD, "board.pdf"))
    arguments = []
    for name in near.names:
        photograph(near, name, tmp_path / f"{name}.png")
        arguments += ["--floor", f"{name}={tmp_path / name}.png"]
    out = tmp_path / "new.toml"
    code, text, errors = run(
        monkeypatch, capsys, old, "--board", tmp_path / "board.toml", *arguments, "--out", out
    )
    assert code == 0, errors
    assert "world: good" in text, text + errors
    assert_same_cameras(load_rig(out), near, 0.01)
    (tmp_path / "cam0.png").write_bytes((tmp_path / "cam1.png").read_bytes()[:100])
    code, _, errors = run(
        monkeypatch, capsys, old, "--board", tmp_path / "board.toml", *arguments, "--out", out
    )
    assert code == 1
    assert "not a readable image" in errors
