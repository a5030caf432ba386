"""Calibration boards as cameras see them: rendered images, or corners with noise."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.board_views import CameraShots, Shot
from fusecap.geometry.camera import Camera

CHARUCO = Board(
    kind="charuco",
    columns=5,
    rows=6,
    square_m=0.06,
    marker_m=0.045,
    dictionary="DICT_4X4_100",
    legacy=False,
)
CHECKERBOARD = Board(kind="checkerboard", columns=7, rows=6, square_m=0.05)
PER_SQUARE = 60
SUPERSAMPLED = 3


def camera(name="cam", *, focal=600.0, size=(640, 480), distortion=(0, 0, 0, 0, 0), pose=None):
    """At the origin unless `pose` (cam_from_world) is given."""
    pose = np.eye(4) if pose is None else pose
    matrix = np.array([[focal, 0, size[0] / 2 + 3], [0, focal, size[1] / 2 - 4], [0, 0, 1.0]])
    return Camera(
        name=name,
        size_px=size,
        matrix=matrix,
        distortion=np.array(distortion, dtype=float),
        rotation=pose[:3, :3],
        translation=pose[:3, 3],
    )


def pose(turn_deg=(0, 0, 0), place=(0, 0, 1.0), board=CHARUCO):
    """cam_from_board with the board's middle at `place` [m]."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    middle = board.corners_in_board_m.mean(axis=0)
    result[:3, 3] = np.array(place) - result[:3, :3] @ middle
    return result


def printed(board):
    """The print of a board, `PER_SQUARE` pixels a square, with a margin of one square."""
    size = (board.columns * PER_SQUARE, board.rows * PER_SQUARE)
    if board.kind == "charuco":
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        pattern = cv2.aruco.CharucoBoard(
            (board.columns, board.rows), board.square_m, board.marker_m, words
        )
        pattern.setLegacyPattern(bool(board.legacy))
        picture = pattern.generateImage(size)
    else:
        row, column = np.indices((board.rows, board.columns))
        black = (row + column) % 2 == 0
        picture = np.kron(np.where(black, 0, 255), np.ones((PER_SQUARE, PER_SQUARE))).astype("u1")
    picture = cv2.copyMakeBorder(picture, *[PER_SQUARE] * 4, cv2.BORDER_CONSTANT, value=255)
    return 255 - picture if board.inverted else picture


def rendered(board, lens, cam_from_board, *, noise=0.0, seed=0):
    """What a camera without distortion sees, grey."""
    to_metres = board.square_m / PER_SQUARE
    board_from_print = np.array(
        [
            [to_metres, 0, (0.5 - PER_SQUARE) * to_metres],
            [0, to_metres, (0.5 - PER_SQUARE) * to_metres],
            [0, 0, 1],
        ]
    )
    plane = lens.matrix @ cam_from_board[:3, [0, 1, 3]] @ board_from_print
    n = SUPERSAMPLED
    finer = np.array([[n, 0, (n - 1) / 2], [0, n, (n - 1) / 2], [0, 0, 1.0]])
    width, height = lens.size_px
    large = cv2.warpPerspective(
        printed(board), finer @ plane, (n * width, n * height), borderValue=90
    )
    image = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA).astype(float)
    if noise:
        image += np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(30 + 0.8 * image, 0, 255).astype(np.uint8)


def projected(board, lens, cam_from_board):
    """Where the corners are (lens at the origin)."""
    points = board.corners_in_board_m @ cam_from_board[:3, :3].T + cam_from_board[:3, 3]
    return lens.project(points)


def seen(board, lens, world_from_board, *, noise_px=0.0, rng=None, least=6):
    """A `BoardView` of the corners inside the image, or None."""
    points = board.corners_in_board_m @ world_from_board[:3, :3].T + world_from_board[:3, 3]
    pixels = lens.project(points)
    inside = np.isfinite(pixels).all(axis=1)
    inside &= ((pixels > 0) & (pixels < np.array(lens.size_px) - 1)).all(axis=1)
    if inside.sum() < least:
        return None
    if noise_px:
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    return BoardView(corner_ids=np.flatnonzero(inside), pixels=pixels[inside])


def shots(lens, views, name=None):
    """`CameraShots` of views by instant."""
    return CameraShots(
        name=name or lens.name,
        source="memory",
        size_px=lens.size_px,
        inspected=len(views),
        blurred=0,
        shots=tuple(
            Shot(instant=i, label=f"frame {i}", view=view, sharpness=0.5)
            for i, view in views.items()
            if view is not None
        ),
    )
