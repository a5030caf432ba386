from dataclasses import replace

import numpy as np
import pytest

from fusecap.errors import InputError
from fusecap.evaluate.datasets.shelf import (
    CHIN,
    HEAD_TOP,
    MID_HIP,
    frame_numbers,
    load_truth,
    score_people,
    shelf_points,
)
from fusecap.evaluate.metrics import position_error_m
from fusecap.evaluate.simulator import placed
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from motions import person, take_of, walk

FRAMES = 20


def take_with(thetas, names):
    return take_of(np.stack(thetas), [person()] * len(names), names=names, rate_hz=25.0)


def write_truth(path, points_by_actor, present=None):
    """Shelf's text from (T, 15, 3) points in our world per actor."""
    lines = [f"15 {FRAMES}"]
    for frame in range(FRAMES):
        actors = [a for a in points_by_actor if present is None or frame in present[a]]
        lines.append(str(len(actors)))
        for actor in actors:
            z_up = points_by_actor[actor][frame] @ Y_UP_FROM_Z_UP
            lines.append(str(actor))
            lines += [" ".join(f"{v:.6g}" for v in row) for row in z_up.T]
            lines.append(" ".join(["1"] * 15))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def two():
    motion = walk(person(), FRAMES, rate_hz=25.0)
    return [placed(motion, centre_m=(-1.0, 0.0)), placed(motion, turn_rad=2.0, centre_m=(1.0, 0.0))]


@pytest.fixture
def truth_path(tmp_path, two):
    points = shelf_points(take_with(two, ("a", "b")))
    return write_truth(tmp_path / "gt.txt", {0: points[0], 2: points[1]})


def test_truth_reads_back_in_our_world(two, truth_path):
    points = load_truth(truth_path).points_in_world_m
    assert points.shape == (3, FRAMES, 15, 3)
    assert np.allclose(points[[0, 2]], shelf_points(take_with(two, ("a", "b"))), atol=1e-5)
    assert np.isnan(points[1]).all()


def test_perfect_take_has_all_limbs_right(two, truth_path):
    score = score_people(take_with(two, ("a", "b")), load_truth(truth_path))
    assert score.pcp == 100.0
    assert score.actor_pcp == {0: 100.0, 2: 100.0}
    assert set(score.limb_pcp.values()) == {100.0}
    assert (score.person_frames, score.missed_person_frames) == (2 * FRAMES, 0)
    assert score.identity_switches == 0


def test_order_and_strangers_do_not_matter(two, truth_path):
    stranger = placed(two[0], centre_m=(4.0, 4.0))
    score = score_people(
        take_with([stranger, two[1], two[0]], ("x", "y", "z")), load_truth(truth_path)
    )
    assert score.pcp == 100.0


def test_missed_person_is_ten_wrong_limbs(two, truth_path):
    score = score_people(take_with(two[:1], ("a",)), load_truth(truth_path))
    assert score.actor_pcp == {0: 100.0, 2: 0.0}
    assert (score.pcp, score.missed_person_frames) == (50.0, FRAMES)


def test_frames_the_take_lacks_are_missed(two, truth_path):
    part = take_with([theta[5:] for theta in two], ("a", "b"))
    part = replace(part, timestamps_ns=part.timestamps_ns + 5 * 40_000_000)
    assert frame_numbers(part)[0] == 5
    score = score_people(part, load_truth(truth_path))
    assert score.pcp == pytest.approx(100.0 * 15 / 20)
    assert score.missed_person_frames == 10


def test_take_without_people_scores_nothing(two, truth_path):
    take = take_with(two, ("a", "b"))
    none = replace(
        take,
        tracked=np.zeros_like(take.tracked),
        bone_position_in_world_m=np.full_like(take.bone_position_in_world_m, np.nan),
    )
    score = score_people(none, load_truth(truth_path))
    assert (score.pcp, score.missed_person_frames) == (0.0, 2 * FRAMES)


def test_wrong_arm_is_one_wrong_limb_and_its_neighbours_stay_right(two, truth_path):
    bent = two[0].copy()
    bent[:, 3 + 3 * person().skeleton.bone("left_forearm") + 1] += 2.5
    score = score_people(take_with([bent, two[1]], ("a", "b")), load_truth(truth_path))
    assert score.actor_pcp == {0: 90.0, 2: 100.0}
    assert score.limb_pcp["lower arms"] == 75.0
    assert score.limb_pcp["upper arms"] == 100.0


def test_swapped_people_are_switches_and_right_limbs(two, truth_path):
    swapped = [two[0].copy(), two[1].copy()]
    swapped[0][10:], swapped[1][10:] = two[1][10:], two[0][10:]
    score = score_people(take_with(swapped, ("a", "b")), load_truth(truth_path))
    assert (score.pcp, score.identity_switches) == (100.0, 2)


def test_actor_three_is_not_scored(tmp_path, two):
    points = shelf_points(take_with(two, ("a", "b")))
    path = write_truth(tmp_path / "gt.txt", {0: points[0], 3: points[1] + 50.0})
    score = score_people(take_with(two, ("a", "b")), load_truth(path))
    assert score.actor_pcp == {0: 100.0}


def test_actor_counts_in_the_frames_that_show_it(tmp_path, two):
    points = shelf_points(take_with(two, ("a", "b")))
    present = {0: range(FRAMES), 1: range(4)}
    path = write_truth(tmp_path / "gt.txt", {0: points[0], 1: points[1]}, present)
    score = score_people(take_with(two, ("a", "b")), load_truth(path))
    assert (score.pcp, score.person_frames) == (100.0, FRAMES + 4)


def test_head_points_follow_the_rule():
    theta = walk(person(), 1)
    theta[:, 3 + 3 * person().skeleton.bone("head") + 1] = 1.0
    points = shelf_points(take_with([theta], ("a",)))[0, 0]
    shoulders = (points[8] + points[9]) / 2
    assert np.allclose(points[HEAD_TOP] - points[CHIN], [0, 0.145, 0.125], atol=1e-9)
    assert shoulders[1] < points[CHIN][1] < points[HEAD_TOP][1]
    assert np.allclose(points[MID_HIP], (points[2] + points[3]) / 2)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "14 3\n",
        "15 2\n1\n0\n1 2 3",
        "hello",
        "15 -1",
        "15 1\n1\n-1" + " 1" * 60,
        "15 1\n1\n9999999",
    ],
)
def test_other_text_is_no_truth(tmp_path, content):
    (tmp_path / "gt.txt").write_text(content)
    with pytest.raises(InputError, match=r"gt\.txt"):
        load_truth(tmp_path / "gt.txt")


@pytest.mark.real_data
def test_real_truth_shows_two_standing_actors(data_dir):
    points = load_truth(data_dir / "shelf" / "gt_frames_000_149.txt").points_in_world_m
    present = np.isfinite(points).all(axis=(2, 3)).sum(axis=1)
    assert present.tolist() == [150, 0, 78]
    assert abs(np.nanmedian(points[:, :, [0, 5], 1])) < 0.1
    assert 1.5 < np.nanmedian(points[:, :, HEAD_TOP, 1]) < 1.9
    thigh = position_error_m(points[0, :, 3], points[0, :, 4])
    assert 0.3 < np.median(thigh) < 0.5
