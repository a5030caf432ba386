"""Pages in a browser: figures, time line, floor plan, pictures, words, and who may connect."""

from __future__ import annotations

import asyncio
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import viser
import websockets
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner
from websockets.typing import Origin, Subprotocol

from fusecap.body.pose import landmarks_in_world
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.cli import app
from fusecap.engine.engine import LiveStep
from fusecap.errors import InputError, TakeError
from fusecap.evaluate.errors_over_time import errors_over_time
from fusecap.geometry.quaternions import from_wxyz
from fusecap.live.status import (
    Incident,
    Light,
    LiveStatus,
    RecordingStatus,
    SourceStatus,
    StageLatency,
    StreamStatus,
)
from fusecap.pipeline import Step
from fusecap.setup import SessionSetup
from fusecap.sources.session_file import parse_session
from fusecap.sources.video import Video
from fusecap.take import Take
from fusecap.types import (
    CameraImage,
    CameraSample,
    Command,
    CommandKind,
    Detections,
    Estimate,
    TrackState,
    TrackUpdate,
)
from fusecap.viewer import tables
from fusecap.viewer.backdrop import HungPicture, VideoAtTimes, videos_of
from fusecap.viewer.curves import BoneCurve
from fusecap.viewer.figure import Figure, Pose, pose_of
from fusecap.viewer.floor_plan import FloorDrawing, floor_plan
from fusecap.viewer.live import LiveViewer
from fusecap.viewer.page import Page, note_if_open
from fusecap.viewer.palette import PEOPLE_RGB, person_rgb
from fusecap.viewer.pictures import WIDTH_PX, Pictures, mosaic
from fusecap.viewer.playhead import Playhead
from fusecap.viewer.take import TakePage
from live_fakes import BODY25, live_setup, step_of, wait_for
from motions import person, take_of, walk
from scenes import ring
from session_files import write_session
from video_files import number_of, write_video

NASTY = '<img src=x onerror="document.title=1"> **b** [l](javascript:1) "\'&'
BLUE = PEOPLE_RGB[0]


def pose_in(take: Take, frame: int = 0, row: int = 0) -> Pose:
    return Pose(
        shape=take.shape(row),
        position_m=take.bone_position_in_world_m[row, frame],
        rotation=take.bone_rotation_in_world(row)[frame],
        quality=take.bone_quality[row, frame],
    )


def standing(skeleton=PAPER21, place_m=(0.0, 0.0), frames: int = 1, name: str = "anna") -> Take:
    """In the rest pose, facing +z."""
    shape = person(1.75, skeleton)
    theta = np.zeros((1, frames, skeleton.pose_size))
    theta[..., :3] = place_m[0], shape.standing_root_height_m, place_m[1]
    return take_of(theta, [shape], names=(name,))


def estimate_in(take: Take, name: str | None = None, frame: int = 0) -> Estimate:
    from live_fakes import estimate_of

    pose = pose_in(take, frame)
    found = estimate_of(int(take.timestamps_ns[frame]), name or take.subject_names[0], pose.shape)
    return replace(
        found,
        bone_position_in_world_m=pose.position_m,
        bone_rotation_in_world=pose.rotation,
        views=np.ones(2, dtype=bool),
    )


def keypoints_of(take: Take, camera) -> np.ndarray:
    """(1, k, 3) of the first person, seen perfectly."""
    shape = take.shape(0)
    points = landmarks_in_world(
        take.bone_position_in_world_m[0, :1],
        take.bone_rotation_in_world(0)[:1],
        BODY25.bones(PAPER21),
        BODY25.offsets_m(shape),
    )[0]
    return np.column_stack([camera.project(points), np.ones(len(points))])[None]


# Figures


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23])
def test_figure_stands_on_the_floor_and_looks_ahead(skeleton):
    figure, pose = Figure(skeleton), pose_in(standing(skeleton))
    balls, sticks = figure.balls(pose, BLUE), figure.sticks(pose, BLUE)
    assert len(balls.position_m) == figure.ball_count
    assert len(sticks.position_m) == figure.stick_count
    lowest = (balls.position_m - balls.scale_m)[:, 1].min()
    assert -0.01 < lowest < 0.03
    head, nose = balls.position_m[-2:]
    assert nose[2] > head[2] + 0.05
    left, right = skeleton.bone("left_hand"), skeleton.bone("right_hand")
    assert balls.position_m[left, 0] > 0.5 > -0.5 > balls.position_m[right, 0]


@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_sticks_reach_from_joint_to_joint(rotvec):
    take = standing()
    pose = pose_in(take)
    turn = Rotation.from_rotvec(rotvec)
    turned = replace(
        pose,
        position_m=turn.apply(pose.position_m),
        rotation=turn.as_matrix() @ pose.rotation,
    )
    sticks = Figure(PAPER21).sticks(turned, BLUE)
    along = Rotation.from_quat(sticks.wxyz, scalar_first=True).apply(
        np.tile([0.0, 1.0, 0.0], (len(sticks.wxyz), 1))
    )
    ends = sticks.position_m + along * sticks.scale_m[:, 1:2]
    children = [bone for bone, parent in enumerate(PAPER21.parents) if parent >= 0]
    assert np.allclose(ends[: len(children)], turned.position_m[children], atol=1e-6)


def test_right_side_is_darker_and_unmeasured_bones_are_pale():
    figure, pose = Figure(PAPER21), pose_in(standing())
    rgb = figure.balls(pose, BLUE).rgb.astype(int)
    left, right = PAPER21.bone("left_hand"), PAPER21.bone("right_hand")
    assert tuple(rgb[left]) == BLUE
    assert (rgb[right] <= rgb[left]).all() and rgb[right].sum() < rgb[left].sum()
    pale = figure.balls(replace(pose, quality=np.zeros(21)), BLUE).rgb.astype(int)
    assert np.ptp(pale[left]) < np.ptp(rgb[left]) / 2


# Time line


def test_playhead_goes_round_and_pauses_at_the_end_without_loop():
    head = Playhead(np.arange(11) / 10)
    head.advance(0.25)
    assert head.frame == 2
    head.speed = 2.0
    head.advance(0.25)
    assert head.position_s == pytest.approx(0.75)
    head.advance(0.25)
    assert head.position_s == pytest.approx(0.25) and head.playing
    head.loop = False
    head.advance(5.0)
    assert head.frame == 10 and not head.playing
    head.toggle()
    assert head.frame == 0 and head.playing


def test_playhead_steps_by_frames_and_stays_within():
    head = Playhead(np.array([0.0, 0.1, 0.35]))
    head.step(1)
    assert (head.frame, head.position_s, head.playing) == (1, 0.1, False)
    head.advance(1.0)
    assert head.frame == 1
    head.step(5)
    assert head.frame == 2
    head.seek(-3.0)
    assert head.frame == 0


# Errors over time


def test_errors_are_those_of_the_person_matched_and_nan_where_nobody_is():
    truth = take_of(np.stack([walk(person(), 8)]), [person()], names=("true",))
    moved = truth.theta.copy()
    moved[..., 0] += 0.02
    take = take_of(moved, [person()], names=("anna",))
    errors = errors_over_time(take, truth)
    assert np.allclose(errors.position_mm["anna"], 20.0)
    assert np.allclose(errors.orientation_deg["anna"], 0.0, atol=1e-4)
    moved[..., 0] += 2.0
    far = errors_over_time(take_of(moved, [person()], names=("anna",)), truth)
    assert np.isnan(far.position_mm["anna"]).all()


# Floor plan


def sorted_step(take: Take, rig, *, assigned: bool) -> LiveStep:
    people = tuple(keypoints_of(take, camera) for camera in rig.cameras)
    update = TrackUpdate(
        track_id=1,
        name="",
        state=TrackState.TENTATIVE,
        person=np.zeros(len(rig), dtype=int),
        landmarks_in_world_m=np.full((25, 3), [0.5, 1.0, -1.0]),
    )
    return LiveStep(
        timestamp_ns=0,
        detections=Detections(timestamp_ns=0, people=people),
        readings={},
        step=Step(updates=(update,) if assigned else (), estimates=()),
        people={"anna": None},
    )


def test_a_detection_that_nobody_was_given_is_a_bystander_where_its_ankles_stand():
    rig, take = ring(3), standing(place_m=(0.4, -0.7))
    plan = floor_plan(sorted_step(take, rig, assigned=False), rig, BODY25)
    assert len(plan.bystanders) == 3
    assert np.allclose(plan.bystanders, [0.4, -0.7], atol=0.05)
    assert not plan.subjects and not plan.candidates


def test_a_newcomer_under_trial_is_a_candidate():
    rig = ring(3)
    plan = floor_plan(sorted_step(standing(), rig, assigned=True), rig, BODY25)
    assert not plan.bystanders
    assert np.allclose(plan.candidates, [[0.5, -1.0]])


# Words


def status(name: str = "anna") -> LiveStatus:
    def source(kind: str, name: str, light: Light) -> SourceStatus:
        return SourceStatus(
            name=name,
            kind=kind,
            light=light,
            rate_hz=30.0,
            age_s=0.4,
            received=9,
            dropped=2,
            note=NASTY,
        )

    return LiveStatus(
        elapsed_s=3661.0,
        detections_per_s=19.5,
        solves_per_s=60.0,
        packets_per_s=59.9,
        late_share=0.01,
        sources=(
            source("camera", name, Light.FRESH),
            source("imu", f"{name}/head", Light.LATE),
            source("imu", f"{name}/hips", Light.LOST),
        ),
        latency=(
            StageLatency(stage="solve", p50_ms=1.0, p95_ms=2.0, p99_ms=3.0, count=9),
        ),
        streams=(
            StreamStatus(to=name, sent=1, dropped=2, refused=3, failed=4, remark=NASTY),
        ),
        recording=RecordingStatus(path=name, megabytes=1.0, seconds=2.0),
        incidents=(Incident(time_s=1.0, what=NASTY),),
        cpu_share=0.5,
        memory_mb=300.0,
    )  # fmt: skip


def test_names_from_outside_are_shown_letter_by_letter():
    nasty, rig = status(NASTY), ring(2)
    estimate = estimate_in(standing(), NASTY)
    step = step_of(0, [estimate], cameras=2)
    plan = floor_plan(step, rig, BODY25)
    html = "".join(
        [
            tables.lights(nasty.sources),
            tables.numbers(nasty),
            tables.latency(nasty),
            tables.streams(nasty),
            tables.incidents(nasty),
            tables.people(step, {NASTY: BLUE}),
            FloorDrawing(rig).svg(plan, {NASTY: BLUE}),
        ]
    )
    assert "<img" not in html and 'onerror="' not in html
    assert "&lt;img src=x" in html


def test_lights_differ_by_symbol_too():
    html = {light: tables.lights([replace(status().sources[0], light=light)]) for light in Light}
    symbols = {text.split("</span>")[0].rpartition(">")[2] for text in html.values()}
    assert len(symbols) == len(Light)
    assert "1:01:01" in tables.numbers(status())


# Pictures


def test_a_picture_waits_for_its_instant_and_shows_who_was_found_and_solved():
    rig, take = ring(2), standing()
    pictures = Pictures(rig, BODY25)
    estimate = estimate_in(take)
    image = np.zeros((1080, 1920, 3), np.uint8)
    pictures.offer(CameraImage(camera=1, timestamp_ns=20, image=image))
    pictures.sample(
        CameraSample(camera=1, timestamp_ns=20, people=keypoints_of(take, rig.cameras[1]))
    )
    colours = {"anna": BLUE}
    assert pictures.ready(step_of(10, [estimate], cameras=2), colours) == []
    assert pictures.ready(step_of(30, [estimate], cameras=2), colours) == [1]
    picture = pictures.drawn[1]
    assert picture.shape == (180, WIDTH_PX, 3)
    spine = estimate.bone_position_in_world_m[[PAPER21.bone("spine1")]]
    x, y = np.round(rig.cameras[1].project(spine)[0] * WIDTH_PX / 1920).astype(int)
    assert np.abs(picture[y, x].astype(int) - BLUE).max() < 60
    assert (picture.min(axis=2) > 120).any(), "no white line"
    pictures.offer(CameraImage(camera=1, timestamp_ns=40, image=image))
    assert pictures.ready(step_of(50, [estimate], cameras=2), colours) == []
    assert mosaic(pictures.drawn, rig.names).shape == (180, 2 * WIDTH_PX, 3)


def test_keypoints_without_pictures_wait_for_their_instant_too():
    rig = ring(1)
    pictures = Pictures(rig, BODY25)
    shown = []
    for timestamp_ns in range(0, 1_000_000_000, 10_000_000):
        pictures.sample(
            CameraSample(camera=0, timestamp_ns=timestamp_ns, people=np.zeros((0, 25, 3)))
        )
        late_ns = timestamp_ns - 50_000_000
        shown += [timestamp_ns for _ in pictures.ready(step_of(late_ns, cameras=1), {})]
    assert 4 <= len(shown) <= 5


def test_people_far_beside_a_camera_do_not_overflow_the_drawing():
    rig = ring(1)
    pictures = Pictures(rig, BODY25)
    people = np.full((1, 25, 3), 1e12)
    pictures.draw(0, None, people, {"anna": pose_in(standing(place_m=(9e3, 4.0)))}, {"anna": BLUE})
    assert pictures.drawn[0].shape == (180, WIDTH_PX, 3)


# Pages


@contextmanager
def page_of(**options) -> Iterator[Page]:
    page = Page("test", **options)
    try:
        yield page
    finally:
        page.stop()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_port_that_is_taken_is_named_and_another_is_found_where_none_was_asked_for():
    with page_of() as first, page_of() as second:
        assert first.get_port() != second.get_port()
        assert first.address.startswith("http://127.0.0.1:") and not first.is_open
        assert note_if_open(first) is None
        with pytest.raises(InputError, match=f"port {first.get_port()} .* is taken; .*--port"):
            Page("test", port=first.get_port())


def test_an_address_of_another_machine_is_refused_with_words():
    with pytest.raises(InputError, match=r"--host 192\.0\.2\.1: not an address of this machine"):
        Page("test", host="192.0.2.1", port=free_port())


def test_an_open_page_says_so():
    with page_of(host="0.0.0.0", port=free_port()) as page:
        assert page.is_open and "open to other machines" in (note_if_open(page) or "")


def test_only_pages_served_here_may_connect():
    async def close_code(port: int, origin: str | None) -> int | None:
        """With which the server closes the connection; None where it sends something instead."""
        async with websockets.connect(
            f"ws://127.0.0.1:{port}",
            origin=None if origin is None else Origin(origin),
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None,
        ) as connection:
            try:
                await asyncio.wait_for(connection.recv(), 20)
            except websockets.ConnectionClosed as closed:
                return closed.rcvd.code if closed.rcvd else 0
            return None

    with page_of() as page:
        port = page.get_port()
        assert asyncio.run(close_code(port, f"http://127.0.0.1:{port}")) is None
        assert asyncio.run(close_code(port, None)) is None
        assert asyncio.run(close_code(port, "https://example.com")) == 1008
        assert asyncio.run(close_code(port, f"http://127.0.0.1:{port + 1}")) == 1008


def test_a_page_is_never_shared_through_a_public_server():
    with page_of() as page:
        assert page.request_share_url() is None


def test_a_take_without_frames_cannot_be_viewed():
    take = take_of(np.zeros((1, 0, PAPER21.pose_size)), [person()], names=("anna",))
    with page_of() as page, pytest.raises(TakeError, match="no frame"):
        TakePage(page, take)


def test_view_of_a_file_that_is_not_there_is_one_line():
    result = CliRunner().invoke(app, ["view", "nowhere.npz", "--no-browser"])
    assert isinstance(result.exception, TakeError) and "nowhere.npz" in str(result.exception)


# Videos behind figures


def test_a_frame_is_the_nearest_to_a_time_wherever_one_jumps(tmp_path: Path):
    video = Video(write_video(tmp_path / "a.mp4", 90, rate_hz=30.0))
    found = VideoAtTimes(video, 5.0 + np.arange(90) / 30.0)
    assert found.at(4.9) is None and found.at(8.2) is None
    for number in (3, 4, 4, 9, 80, 2, 89, 0):
        frame = found.at(5.0 + number / 30.0 + 0.01)
        assert frame is not None and frame.number == number == number_of(frame.image)


def test_videos_are_opened_when_they_are_asked_for_and_with_words(tmp_path: Path):
    calibrated = write_session(tmp_path, frames=2, cameras=2)
    text = calibrated.read_text()
    calibrated.write_text(text.replace('name = "cam0"', 'name = "cam0"\nvideo = "cam0.mp4"'))
    (tmp_path / "cam0.mp4").write_bytes(b"no video")
    videos = videos_of(parse_session(calibrated))
    assert list(videos) == ["cam0"]
    with pytest.raises(InputError, match=r"cam0\.mp4"):
        videos["cam0"]()


def test_a_picture_hangs_where_the_rays_of_its_pixels_go():
    """Also with a bent lens whose middle is not the picture's, at another size than calibrated."""
    camera = replace(
        ring(1, distortion=(-0.2, 0.05, 0.002, -0.001, 0.0)).cameras[0],
        matrix=np.array([[1100.0, 0, 900], [0, 1110.0, 600], [0, 0, 1]]),
    )
    place_m = np.array([[0.4, 1.3, -0.3]])
    view = HungPicture(camera, place_m)
    film = np.zeros((540, 960, 3), np.uint8)
    cv2.circle(
        film, tuple(np.round(camera.project(place_m)[0] / 2).astype(int)), 6, (0, 0, 255), -1
    )
    picture = view.picture(film)
    rows, columns = np.nonzero(picture[..., 0] > 128)
    height, width = picture.shape[:2]
    share = np.array([columns.mean() + 0.5, rows.mean() + 0.5]) / [width, height] - 0.5
    on_picture = [*(share * view.size_m), 0.0]
    hung = view.centre_in_world_m + from_wxyz(view.wxyz).apply(on_picture)
    centre = camera.position_in_world
    to_person, to_picture = place_m[0] - centre, hung - centre
    assert np.linalg.norm(to_picture) > np.linalg.norm(to_person) + 1.0
    cosine = to_person @ to_picture / np.linalg.norm(to_person) / np.linalg.norm(to_picture)
    assert np.degrees(np.arccos(cosine)) < 0.1


# In a browser


@pytest.fixture
def browser() -> Iterator:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on the PATH")
    from playwright.sync_api import sync_playwright

    software = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=software)
        try:
            yield browser
        finally:
            browser.close()


def opened(browser, page: Page | LiveViewer) -> tuple:
    """A browser's page of `page`, and the hosts that it asked for anything."""
    shown = browser.new_page(viewport={"width": 900, "height": 700})
    shown.set_default_timeout(60_000)
    hosts: set[str] = set()
    shown.on("request", lambda request: hosts.add(request.url.split("/")[2]))
    shown.goto(page.address)
    shown.wait_for_selector("canvas")
    return shown, hosts


@contextmanager
def in_thread(run: Callable[[threading.Event], None]) -> Iterator[None]:
    stopping = threading.Event()
    thread = threading.Thread(target=run, args=(stopping,))
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(20)


def canvas_of(shown) -> np.ndarray:
    clip = {"x": 0, "y": 160, "width": 500, "height": 540}
    data = np.frombuffer(shown.screenshot(clip=clip, timeout=60_000), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture is not None
    return picture.astype(int)


@pytest.mark.slow
def test_a_take_is_seen_and_scrubbing_moves_it(browser, tmp_path: Path):
    take = take_of(np.stack([walk(person(), 120)]), [person()], names=(NASTY,))
    curves = [
        BoneCurve(title="error (mm)", time_s=take.time_s, by_person={NASTY: np.ones((120, 21))})
    ]
    red = np.full((90, 160, 3), (0, 0, 255), np.uint8)
    video = Video(write_video(tmp_path / "cam1.mp4", 60, picture=lambda _: red))
    videos = {"cam1": lambda: VideoAtTimes(video, np.arange(60) / 30.0)}
    with page_of() as page:
        shown_take = TakePage(page, take, rig=ring(3), videos=videos, curves=curves)
        with in_thread(shown_take.run):
            shown, hosts = opened(browser, page)
            button = shown.get_by_role("button", name="Pause")
            button.click()
            shown.get_by_role("button", name="Play", exact=True).wait_for()
            for label in ("-1 frame", "+1 frame", "corner", "top"):
                assert shown.get_by_role("button", name=label, exact=True).count() == 1
            shown.get_by_role("button", name="front", exact=True).click()
            shown.wait_for_timeout(1500)
            before = canvas_of(shown)
            blue = (before[..., 0] - before[..., 2]) > 40
            assert blue.sum() > 300, "no person in the picture"
            slider = shown.get_by_role("slider").first
            slider.focus()
            for _ in range(40):
                slider.press("ArrowRight")
            shown.get_by_role("button", name="+1 s", exact=True).click()
            shown.wait_for_timeout(1500)
            assert np.abs(canvas_of(shown) - before).max() > 60
            shown.get_by_label("Behind the figures").first.click()
            shown.get_by_role("option", name="cam1").click()
            shown.wait_for_timeout(2000)
            film = canvas_of(shown)
            reddish = (film[..., 2] > 150) & (film[..., :2] < 120).all(axis=2)
            assert reddish.mean() > 0.3, "no video behind the person"
            assert shown.locator("img[src='x']").count() == 0 and shown.title() != "1"
            assert hosts == {page.address.removeprefix("http://")}


class Submitted:
    def __init__(self) -> None:
        self.commands: list[Command] = []

    def submit(self, command: Command) -> None:
        self.commands.append(command)


def setup_for(name: str) -> SessionSetup:
    setup = live_setup(ring(2))
    subject = setup.session.subjects[0].model_copy(update={"name": name})
    return SessionSetup(
        session=setup.session.model_copy(update={"subjects": (subject,)}),
        rig=setup.rig,
        landmarks=setup.landmarks,
    )


@pytest.mark.slow
def test_a_live_run_is_seen_and_its_buttons_become_commands(browser):
    run, recorded = Submitted(), []
    viewer = LiveViewer(setup_for(NASTY), run, on_record=recorded.append)
    take = take_of(np.stack([walk(person(), 600)]), [person()], names=(NASTY,))
    try:
        shown, hosts = opened(browser, viewer)
        stopping = threading.Event()

        def feed() -> None:
            for frame in range(600):
                if stopping.wait(0.05):
                    return
                viewer.on_step(step_of(frame, [estimate_in(take, frame=frame)], cameras=2), frame)
                if frame % 10 == 0:
                    viewer.on_status(status(NASTY))

        feeding = threading.Thread(target=feed)
        feeding.start()
        try:
            shown.get_by_text("±0 deg").wait_for()
            shown.get_by_role("button", name="Find anew").click()
            wait_for(lambda: run.commands)
            assert run.commands == [Command(kind=CommandKind.REINITIALISE)]
            shown.get_by_role("button", name="Calibrate in the T-pose").click()
            wait_for(lambda: len(run.commands) == 2, 60)
            assert run.commands[1] == Command(kind=CommandKind.TPOSE)
            shown.get_by_role("button", name="Add a person").click()
            wait_for(lambda: len(run.commands) == 3)
            shown.get_by_role("button", name="recording").click()
            wait_for(lambda: recorded == [False])
            assert shown.locator("img[src='x']").count() == 0 and shown.title() != "1"
            assert hosts == {viewer.address.removeprefix("http://")}
        finally:
            stopping.set()
            feeding.join()
    finally:
        viewer.close()


def test_a_viewer_that_nobody_watches_closes_at_once(tmp_path: Path):
    viewer = LiveViewer(setup_for("anna"), Submitted())
    viewer.on_event(CameraSample(camera=0, timestamp_ns=1, people=np.zeros((0, 25, 3))), 1)
    viewer.on_step(step_of(1, cameras=2), 1)
    viewer.on_status(status())
    viewer.close()
    assert person_rgb(0) == person_rgb(len(PEOPLE_RGB))
    assert pose_of(estimate_in(standing())).quality.all()
