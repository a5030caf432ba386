"""What one view says about another, and one picture about the next."""

import numpy as np
import pytest

from fusecap.geometry.epipolar import essential_matrix
from fusecap.geometry.same_people import same_people
from people_scene import ring_of_cameras


def test_point_lies_on_the_line_that_another_view_gives(rng):
    first, second = ring_of_cameras(3).cameras[:2]
    essential = essential_matrix(
        (first.rotation, second.rotation), (first.position_in_world, second.position_in_world)
    )
    points = rng.uniform([-1, 0, -1], [1, 2, 1], (20, 3))
    x, y = (points @ view.rotation.T + view.translation for view in (first, second))
    x, y = x / x[:, 2:], y / y[:, 2:]
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", y, essential, x), 0.0, atol=1e-12)
    aside = y + [0.0, 0.01, 0.0]
    assert np.all(np.abs(np.einsum("ni,ij,nj->n", aside, essential, x)) > 1e-3)
    # The matrix of views one metre apart has two singular values of one.
    np.testing.assert_allclose(np.linalg.svd(essential)[1], [1.0, 1.0, 0.0], atol=1e-12)


def test_views_from_one_place_have_no_lines():
    (camera,) = ring_of_cameras(1).cameras
    rotations = (camera.rotation, camera.rotation)
    position = camera.position_in_world
    assert not essential_matrix(rotations, (position, position)).any()


def body(x, count=6):
    """A person 100 px high."""
    return np.column_stack([np.full(count, x), np.linspace(0, 100, count), np.ones(count)])


@pytest.mark.parametrize(
    ("second", "same"),
    [
        ([body(310.0), body(105.0)], [(0, 1), (1, 0)]),
        ([body(120.0), body(140.0)], [(0, 0)]),
        ([body(126.0)], []),
        ([], []),
    ],
)
def test_people_of_two_pictures_are_paired_within_a_quarter_of_their_extent(second, same):
    first, second = np.stack([body(100.0), body(300.0)]), np.array(second).reshape(-1, 6, 3)
    rows, columns = same_people(first, second, gate_extents=0.25)
    assert list(zip(rows, columns, strict=True)) == same


def test_people_without_a_common_keypoint_are_never_the_same():
    upper, lower = body(100.0)[None], body(100.0)[None]
    upper[:, :3, :2] = lower[:, 3:, :2] = np.nan
    assert len(same_people(upper, lower, gate_extents=0.25)[0]) == 0
