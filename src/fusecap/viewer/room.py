"""The room people stand in: floor, light, cameras, and where one looks from at first."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.quaternions import to_wxyz
from fusecap.viewer.palette import CAMERA_RGB

_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "corner": (0.55, 0.45, 1.0),
    "front": (0.0, 0.25, 1.0),
    "side": (1.0, 0.25, 0.0),
    "top": (0.0, 1.0, 0.001),
}
"""From what is looked at to the eye; people in the rest pose face +z."""
_FOV_RAD = 0.8
_MIN_RADIUS_M = 1.3
"""Of what fills the picture."""
_EYE_HEIGHT_M = 0.95
_LOOKED_AT_M = 4.0
"""From a camera to the place about which its view is turned."""
_NEW_SHAPE = 0.03
"""Change of a picture's shape from which it is framed anew."""


class Room:
    """What stands still."""

    def __init__(
        self, page: viser.ViserServer, rig: Rig | None, *, frustum_m: float = 0.28
    ) -> None:
        self._page = page
        self._looked: tuple[Float[np.ndarray, "n 3"], str] | Camera = np.zeros((1, 3)), "corner"
        self._cameras_shown = True
        page.on_client_connect(self._welcome)
        page.scene.add_grid(
            "/floor",
            plane="xz",
            infinite_grid=True,
            cell_size=0.5,
            section_size=1.0,
            cell_color=(225, 225, 225),
            section_color=(190, 190, 190),
            fade_distance=25.0,
            shadow_opacity=0.25,
        )
        self.frusta = (
            {camera.name: _frustum(page, camera, frustum_m) for camera in rig.cameras}
            if rig
            else {}
        )
        for camera in rig.cameras if rig else ():
            page.scene.add_label(
                f"/cameras/{_node(camera.name)}/name",
                camera.name,
                position=(0.0, -0.16, 0.0),
                anchor="bottom-center",
                font_screen_scale=0.75,
            )

    def show_cameras(self, visible: bool) -> None:
        """Or hide them, with their names."""
        self._cameras_shown = visible
        self._show_frusta()

    def look(self, at: Float[np.ndarray, "n 3"], view: str = "corner") -> None:
        """Whoever is there or comes sees these places on the floor, and people who stand there."""
        self._looked = at, view
        self._show_frusta()
        self._turn_all()

    def look_through(self, camera: Camera) -> None:
        """Whoever is there or comes sees what the camera sees, all of it."""
        self._looked = camera
        self._show_frusta()
        self._turn_all()

    def _welcome(self, client: viser.ClientHandle) -> None:
        """The picture takes its final shape only after the first look, when the panel is there."""
        seen = 0.0

        @client.camera.on_update
        def _(camera: viser.CameraHandle) -> None:
            nonlocal seen
            if abs(camera.aspect - seen) > _NEW_SHAPE * seen:
                seen = camera.aspect
                self._turn(client)

    def _show_frusta(self) -> None:
        through = self._looked.name if isinstance(self._looked, Camera) else None
        for name, frustum in self.frusta.items():
            frustum.visible = self._cameras_shown and name != through

    def _turn_all(self) -> None:
        for client in self._page.get_clients().values():
            self._turn(client)

    def _turn(self, client: viser.ClientHandle) -> None:
        if isinstance(self._looked, Camera):
            _place(client, self._looked)
            return
        at, view = self._looked
        centre, radius_m = _framed(at)
        half_rad = min(_FOV_RAD, 2 * np.arctan(np.tan(_FOV_RAD / 2) * client.camera.aspect)) / 2
        direction = np.array(_DIRECTIONS[view])
        eye = centre + radius_m / np.sin(half_rad) * direction / np.linalg.norm(direction)
        with client.atomic():
            client.camera.up_direction = (0.0, 1.0, 0.0)
            client.camera.fov = _FOV_RAD
            client.camera.position, client.camera.look_at = eye, centre


def add_view_controls(
    page: viser.ViserServer, room: Room, at: Callable[[], Float[np.ndarray, "n 3"]]
) -> None:
    """Buttons that look at places on the floor from all sides; the first look is from a corner."""
    room.look(at())
    with page.gui.add_folder("View"):
        views = page.gui.add_button_group("From", tuple(_DIRECTIONS))
        views.on_click(lambda event: room.look(at(), event.target.value))
        if room.frusta:
            cameras = page.gui.add_checkbox("Cameras", initial_value=True)
            cameras.on_update(lambda event: room.show_cameras(event.target.value))


def places_of(paths_m: Sequence[Float[np.ndarray, "n 3"]]) -> Float[np.ndarray, "n 3"]:
    """Where people are at some time; the origin where nobody ever is."""
    points = np.concatenate([*paths_m, np.empty((0, 3))])
    points = points[np.isfinite(points).all(axis=1)]
    return points if len(points) else np.zeros((1, 3))


def _framed(at: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of a sphere that holds people who stand there."""
    low, high = at.min(axis=0), at.max(axis=0)
    centre = np.array([(low[0] + high[0]) / 2, _EYE_HEIGHT_M, (low[2] + high[2]) / 2])
    radius_m = max(_MIN_RADIUS_M, 0.8 + float(np.hypot(*(high - low)[[0, 2]])) / 2)
    return centre, radius_m


def _place(client: viser.ClientHandle, camera: Camera) -> None:
    """Where the camera is, as wide as its picture needs in the client's window."""
    size, middle = np.array(camera.size_px), camera.matrix[:2, 2]
    reach = np.maximum(middle, size - middle) / camera.matrix[[0, 1], [0, 1]]
    half = max(reach[1], reach[0] / client.camera.aspect)
    with client.atomic():
        client.camera.up_direction = -camera.rotation[1]
        client.camera.fov = float(2 * np.arctan(half))
        client.camera.position = camera.position_in_world
        client.camera.look_at = camera.position_in_world + _LOOKED_AT_M * camera.rotation[2]


def _frustum(page: viser.ViserServer, camera: Camera, size_m: float) -> viser.CameraFrustumHandle:
    width, height = camera.size_px
    return page.scene.add_camera_frustum(
        f"/cameras/{_node(camera.name)}",
        fov=float(2 * np.arctan2(height / 2, camera.matrix[1, 1])),
        aspect=width / height,
        scale=size_m,
        thickness=0.008,
        color=CAMERA_RGB,
        wxyz=to_wxyz(Rotation.from_matrix(camera.rotation.T)),
        position=camera.position_in_world,
        cast_shadow=False,
        receive_shadow=False,
    )


def _node(name: str) -> str:
    """A name of any letters as one step of a path in the scene."""
    return name.encode().hex()
