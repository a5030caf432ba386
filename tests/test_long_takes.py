"""What keeps the memory of a solve flat: files in place of lists, counts in place of numbers."""

import os

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fusecap.batch.assignments import Assignments
from fusecap.body.skeleton import PAPER21
from fusecap.errors import FusecapError
from fusecap.files import Spool
from fusecap.solve.quantiles import Quantiles
from fusecap.sources.people_store import PeopleStore, changed
from fusecap.take import MOTION, save_take
from fusecap.types import TrackState, TrackUpdate
from motions import person, solved, take_of


def crowd(rng, count, frame):
    return rng.uniform(0.0, 100.0, (count, 25, 3)) + frame


@pytest.mark.parametrize("in_memory", [1 << 22, 1000], ids=["in memory", "on disk"])
def test_people_come_back_as_they_were_in_any_order(rng, monkeypatch, in_memory):
    monkeypatch.setattr(Spool, "IN_MEMORY", in_memory)
    frames = [crowd(rng, count, frame) for frame, count in enumerate([2, 0, 1, 3, 0, 2])]
    store = PeopleStore(25, 3)
    for people in frames:
        store.append(people)
        assert_array_equal(store[0], frames[0])  # reading between writes
    assert len(store) == 6
    for index in (5, -1, 1, 3):
        assert_array_equal(store[index], frames[index])
    assert [len(people) for people in store[::2]] == [2, 1, 0]
    assert [len(people) for people in store] == [2, 0, 1, 3, 0, 2]
    with pytest.raises(IndexError, match="frame 6 of 6"):
        store[6]


def test_changed_people_are_made_when_somebody_asks(rng):
    frames = [crowd(rng, frame % 3, frame) for frame in range(600)]
    calls = []

    def doubled(people):
        calls.append(len(people))
        return 2.0 * people

    twice = changed(frames, doubled)
    assert len(twice) == 600 and not calls
    assert_array_equal(twice[500], 2.0 * frames[500])
    assert_array_equal(twice[301], 2.0 * frames[301])
    assert len(calls) == 1
    assert [len(people) for people in twice] == [len(people) for people in frames]


def test_a_full_disk_is_told_of(monkeypatch):
    spool = Spool()

    def full(data):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(spool._file, "write", full)
    with pytest.raises(FusecapError, match=r"No space left.*TMPDIR"):
        spool.append(b"1")
    monkeypatch.setattr(spool._file, "seek", full)
    with pytest.raises(FusecapError, match=r"No space left.*TMPDIR"):
        spool.read(0, 1)


def test_what_an_interrupt_left_half_done_is_written_over():
    spool = Spool()
    spool.append(b"aabb")
    spool.append(b"cc", at=2)
    assert spool.read(0, 9) == b"aacc" and len(spool) == 4


def test_quantiles_are_those_of_all_numbers_within_a_step(rng):
    values = rng.lognormal(sigma=2.0, size=5000)
    quantiles = Quantiles()
    assert np.isnan(quantiles.at(0.5))
    for part in np.split(values, 500):
        quantiles.add(part)
    quantiles.add(np.full(3, np.nan))
    assert quantiles.count == 5000
    for share in (0.1, 0.5, 0.9, 0.99):
        assert quantiles.at(share) == pytest.approx(np.quantile(values, share), rel=6e-3)


def test_a_take_that_is_written_as_it_is_made_is_the_same_file(rng, tmp_path):
    theta = rng.normal(size=(2, 2100, PAPER21.pose_size)) * 0.1
    take = take_of(theta, [person(1.6), person(1.9)], names=("anna", "ben"))
    take.tracked[1, 40:60] = False
    for name in MOTION:
        getattr(take, name)[1, 40:60] = np.nan
    handed = solved(take)
    handed.save(tmp_path / "streamed.npz")
    save_take(handed.take, tmp_path / "whole.npz")
    assert (tmp_path / "streamed.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    assert_allclose(handed.take.theta, take.theta, atol=1e-12)


def update(track_id, name, state, seen=True):
    return TrackUpdate(
        track_id=track_id,
        name=name,
        state=state,
        person=np.array([0 if seen else -1, -1]),
        landmarks_in_world_m=np.full((25, 3), float(track_id)),
    )


def test_tracks_bear_the_name_that_they_were_confirmed_under_from_the_start():
    tentative, confirmed = TrackState.TENTATIVE, TrackState.CONFIRMED
    assigned = Assignments(cameras=2, landmarks=25, pose_size=66)
    assigned.add([update(1, "", tentative), update(7, "", tentative)], [])
    assigned.add([update(2, "", tentative), update(1, "anna", confirmed, seen=False)], [])
    assigned.add([update(2, "ben", confirmed)], [])
    assigned.settle()
    assert assigned.names == {"anna", "ben"}
    assert [{one.update.name for one in assigned[row]} for row in range(3)] == [
        {"anna"},
        {"anna", "ben"},
        {"ben"},
    ]
    assert assigned.here(1) == {"ben": True, "anna": False}
    assert [one.update.landmarks_in_world_m[0, 0] for one in assigned[1]] == [2.0, 1.0]
    assigned.keep(1, {"ben"})
    assert [one.update.name for one in assigned[1]] == ["ben"]
    assert all(one.seed is None for one in assigned[2])
