"""The video of one camera behind the figures of a take.

The picture, without its lens's distortion, hangs in the room beyond everybody, where the camera's
rays meet it: seen from the camera's place, in a window of any shape, figures cover the people that
they were solved from. One camera at a time, so that frames are decoded as fast as they are shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import viser
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from viser import GuiEvent

from fusecap.errors import FusecapError
from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.quaternions import to_wxyz
from fusecap.sources.session import CameraSettings, Session
from fusecap.sources.session_data import video_times_s
from fusecap.sources.video import Video, VideoFrame
from fusecap.viewer.palette import escaped
from fusecap.viewer.room import Room

RATE_HZ = 30.0
"""Most pictures per second."""
_NONE = "(none)"
_WIDTH_PX = 960
_JPEG_QUALITY = 80
_BEYOND_M = 1.5
"""From whoever is farthest to the picture."""
_NEAREST_M = 3.0
_SKIPPED = 60
"""Frames up to which decoding goes on rather than seeks."""

Picture = UInt8[np.ndarray, "h w 3"]


class VideoAtTimes:
    """The frames of a video by the time at which they were exposed."""

    def __init__(self, video: Video, times_s: Float[np.ndarray, " f"]) -> None:
        """`times_s` rises; raises `InputError` from `at` where the file cannot be read."""
        self._video = video
        self.times_s = times_s
        self._frame: VideoFrame | None = None
        self._coming: Iterator[VideoFrame] = iter(())
        self._goal = 0

    def at(self, time_s: float) -> VideoFrame | None:
        """The nearest that can be decoded; None farther than a frame from the first or last."""
        period_s = 1.0 / self._video.info.rate_hz
        if not self.times_s[0] - period_s <= time_s <= self.times_s[-1] + period_s:
            return None
        later = min(int(np.searchsorted(self.times_s, time_s)), len(self.times_s) - 1)
        earlier = max(later - 1, 0)
        nearer = time_s - self.times_s[earlier] < self.times_s[later] - time_s
        self._goal = earlier if nearer else later
        now = self._frame.number if self._frame is not None else -_SKIPPED - 1
        if self._goal == now:
            return self._frame
        if not now < self._goal <= now + _SKIPPED:
            self._coming = self._video.frames(self._goal, wanted=lambda n: n >= self._goal)
        self._frame = next(self._coming, self._frame)
        return self._frame


OpenVideo = Callable[[], VideoAtTimes]
"""Raises `InputError` for a file that cannot be read."""


def videos_of(session: Session) -> dict[str, OpenVideo]:
    """Of every camera that has one, opened when asked for, on the session's clock.

    `session` as `fusecap.sources.session_cameras.with_detections` gives it.
    """

    def opened(settings: CameraSettings, path: Path) -> VideoAtTimes:
        video = Video(path)
        return VideoAtTimes(video, video_times_s(session, settings, video))

    return {
        each.name: partial(opened, each, each.video)
        for each in session.cameras
        if each.video is not None
    }


class HungPicture:
    """Where the pictures of a camera hang, and what they look like without distortion."""

    def __init__(self, camera: Camera, people_m: Float[np.ndarray, "n 3"]) -> None:
        """`people_m`: places in the world that pictures hang beyond."""
        self._camera = camera
        scale = _WIDTH_PX / camera.size_px[0]
        width, height = _WIDTH_PX, max(round(camera.size_px[1] * scale), 1)
        focal = camera.matrix[[0, 1], [0, 1]] * scale
        middle = (camera.matrix[:2, 2] + 0.5) * scale - 0.5
        depth = people_m @ camera.rotation[2] + camera.translation[2]
        away_m = max(float(depth.max(initial=0.0)) + _BEYOND_M, _NEAREST_M)
        self.size_m = width / focal[0] * away_m, height / focal[1] * away_m
        offset = (np.array([width - 1, height - 1]) / 2 - middle) / focal
        centre_in_cam = away_m * np.array([*offset, 1.0])
        self.centre_in_world_m = (centre_in_cam - camera.translation) @ camera.rotation
        self.wxyz = to_wxyz(Rotation.from_matrix(camera.rotation.T))
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        rays = np.stack([(x - middle[0]) / focal[0], (y - middle[1]) / focal[1], np.ones_like(x)])
        pixels = camera.project((rays.reshape(3, -1).T - camera.translation) @ camera.rotation)
        found = np.nan_to_num((pixels + 0.5) * scale - 0.5, nan=-1e4)
        columns_rows = found.T.reshape(2, height, width).clip(-1e4, 1e4).astype(np.float32)
        self._from_x, self._from_y = np.ascontiguousarray(columns_rows)

    def picture(self, image: Picture) -> Picture:
        """RGB, 960 px wide, of a BGR frame of any size and the camera's shape."""
        height, width = self._from_x.shape
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        straight = cv2.remap(small, self._from_x, self._from_y, cv2.INTER_LINEAR)
        return cv2.cvtColor(straight, cv2.COLOR_BGR2RGB)


class Backdrop:
    """On a page: a choice of cameras, and the video of the chosen one."""

    def __init__(
        self,
        page: viser.ViserServer,
        room: Room,
        videos: Mapping[str, OpenVideo],
        rig: Rig,
        people_m: Float[np.ndarray, "n 3"],
        on_choice: Callable[[], None],
    ) -> None:
        """`videos` by cameras of `rig`; `people_m`: where people are at some time."""
        self._page, self._room = page, room
        self._videos, self._rig, self._people_m = videos, rig, people_m
        self._chosen = self._opened = _NONE
        self._view: HungPicture | None = None
        self._video: VideoAtTimes | None = None
        self._number = -1
        self._hung: viser.ImageHandle | None = None
        with page.gui.add_folder("Video"):
            names = page.gui.add_dropdown("Behind the figures", (_NONE, *videos))
            again = page.gui.add_button("Look through this camera", visible=False)
            self._note = page.gui.add_html("")

        @names.on_update
        def _(event: GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            self._chosen = event.target.value
            again.visible = self.shown
            self._look()
            on_choice()

        again.on_click(lambda _: self._look())

    @property
    def shown(self) -> bool:
        """Whether a camera is chosen."""
        return self._chosen != _NONE

    def at(self, time_ns: int) -> int:
        """Shows the frame nearest a time; when that was exposed, `time_ns` where there is none."""
        chosen = self._chosen
        try:
            if chosen != self._opened:
                self._open(chosen)
            frame = self._video and self._video.at(time_ns * 1e-9)
        except FusecapError as error:
            self._video = frame = None
            self._say(str(error))
        if self._video is None or self._view is None or frame is None:
            if self._video is not None:
                self._say("no picture at this time")
            self._hang(None)
            return time_ns
        if frame.number != self._number:
            self._say("")
            self._hang(self._view.picture(frame.image))
            self._number = frame.number
        return round(self._video.times_s[frame.number] * 1e9)

    def _open(self, name: str) -> None:
        self._opened, self._video = name, None
        self._say("")
        self._hang(None, gone=True)
        if name != _NONE:
            self._video = self._videos[name]()
            self._view = HungPicture(self._rig[name], self._people_m)

    def _hang(self, picture: Picture | None, *, gone: bool = False) -> None:
        if picture is None:
            self._number = -1
            if self._hung is not None:
                self._hung.visible = False
            if gone and self._hung is not None:
                self._hung.remove()
                self._hung = None
        elif self._hung is not None:
            self._hung.image = picture
            self._hung.visible = True
        elif self._view is not None:
            width_m, height_m = self._view.size_m
            self._hung = self._page.scene.add_image(
                "/video",
                picture,
                width_m,
                height_m,
                format="jpeg",
                jpeg_quality=_JPEG_QUALITY,
                cast_shadow=False,
                receive_shadow=False,
                wxyz=self._view.wxyz,
                position=self._view.centre_in_world_m,
            )

    def _look(self) -> None:
        if self.shown:
            self._room.look_through(self._rig[self._chosen])

    def _say(self, text: str) -> None:
        content = f'<div style="margin:2px 14px;font-size:0.85em">{escaped(text)}</div>'
        if self._note.content != content:
            self._note.content = content
