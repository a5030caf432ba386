"""Clean-up does what it says, tells it, and touches nothing else."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from export_people import degrees_apart, two_walkers, with_gap
from fusecap.batch.report_page import report_page
from fusecap.body.skeleton import PAPER21
from fusecap.cli import app
from fusecap.edits.edit import EditOptions, edit_take
from fusecap.edits.gaps import gaps
from fusecap.errors import InputError, TakeError
from fusecap.feet import standing
from fusecap.stored_take import load_take
from fusecap.take import save_take
from motions import person, take_of, walk


def edited(take, **options):
    return edit_take(take, EditOptions(**options))


def lengths_m(take, row) -> np.ndarray:
    place = take.bone_position_in_world_m[row]
    return np.linalg.norm(place[:, 1:] - place[:, list(take.parents[1:])], axis=-1)


def test_one_person_renamed_trimmed_and_lowered():
    take = two_walkers(60)
    out = edited(
        take,
        only=("ben",),
        rename={"ben": "Ben 2"},
        start_s=0.2,
        end_s=0.5,
        floor_shift_m=-0.03,
    )
    frames = slice(12, 31)
    assert out.subject_names == ("Ben 2",)
    assert np.array_equal(out.timestamps_ns, take.timestamps_ns[frames])
    expected = take.bone_position_in_world_m[1, frames] - [0, 0.03, 0]
    assert np.abs(out.bone_position_in_world_m[0] - expected).max() < 1e-12
    done = [entry["edit"] for entry in out.provenance["edits"]]
    assert done == ["only", "rename", "trim", "floor shift"]
    again = edited(out, floor_shift_m=0.03)
    assert [entry["edit"] for entry in again.provenance["edits"]] == [*done, "floor shift"]


def test_the_report_of_a_solve_is_not_that_of_an_edited_take():
    take = two_walkers(20)
    solved = replace(take, provenance={**take.provenance, "report": {"instants": 20}})
    for out in (edited(solved, only=("ben",)), edited(edited(solved, start_s=0.1), only=("ben",))):
        assert "report" not in out.provenance
        assert out.provenance["report_before_edits"] == {"instants": 20}
        assert "Of the take before its edits." in report_page(out, "t", seen=None)
    assert "report_before_edits" not in edited(take, only=("ben",)).provenance


@given(st.lists(st.booleans(), max_size=30))
def test_gaps_have_tracked_frames_on_both_sides(values):
    tracked = np.array(values, dtype=bool)
    found = np.zeros(len(tracked), dtype=bool)
    for first, end in gaps(tracked):
        assert tracked[first - 1] and tracked[end] and not tracked[first:end].any()
        found[first:end] = True
    known = np.flatnonzero(tracked)
    inside = np.zeros(len(tracked), dtype=bool)
    if len(known):
        inside[known[0] : known[-1] + 1] = True
    assert np.array_equal(found, inside & ~tracked)


def test_short_gaps_are_bridged_and_long_ones_stay():
    whole = two_walkers(90)
    take = with_gap(with_gap(whole, slice(20, 26)), slice(50, 80))
    out = edited(take, fill_gaps_s=0.1)
    assert out.tracked[0, 20:26].all() and not out.tracked[0, 50:80].any()
    assert out.provenance["edits"][0]["frames"] == 6
    error = out.bone_position_in_world_m[0, 20:26] - whole.bone_position_in_world_m[0, 20:26]
    assert np.abs(error).max() < 0.02
    assert (out.bone_sigma_deg[0, 20:26] > take.bone_sigma_deg[0, 19]).any(axis=1).all()
    assert np.allclose(lengths_m(out, 0)[20:26], lengths_m(whole, 0)[0], atol=1e-9)
    outside = [*range(20), *range(26, 50), *range(80, 90)]
    assert np.allclose(out.theta[0, outside], take.theta[0, outside])
    assert not edited(take, fill_gaps_s=0.09).tracked[0, 20:26].any()


def test_wide_error_bars_become_gaps():
    take = two_walkers(10)
    sigma = take.bone_sigma_deg.copy()
    sigma[1, 3:5] = 40.0
    out = edited(take.with_theta(take.theta, bone_sigma_deg=sigma), gaps_above_deg=30)
    assert np.array_equal(np.argwhere(~out.tracked), [[1, 3], [1, 4]])
    assert out.provenance["edits"][0] | {"made_by": ""} == {
        "edit": "mark gaps",
        "above_deg": 30,
        "frames": 2,
        "made_by": "",
    }


def test_butterworth_passes_slow_halves_the_power_at_its_cut_off_and_has_no_lag():
    shape, rate_hz, cutoff_hz = person(), 60.0, 6.0
    time_s = np.arange(600) / rate_hz
    for frequency_hz, gain in ((0.5, 1.0), (cutoff_hz, 0.5**0.5), (20.0, 0.0)):
        theta = np.zeros((1, 600, 66))
        wave = np.sin(2 * np.pi * frequency_hz * time_s)
        theta[0, :, 0] = wave
        theta[0, :, 3 + 3 * PAPER21.bone("left_shank")] = 0.3 * wave
        take = take_of(theta, [shape], names=("a",), rate_hz=rate_hz)
        out = edited(take, butterworth_hz=cutoff_hz)
        inner = slice(120, -120)
        for column, height in ((0, 1.0), (3 + 3 * PAPER21.bone("left_shank"), 0.3)):
            got = out.theta[0, inner, column]
            assert np.abs(got - gain * height * wave[inner]).max() < 0.02 * height
        assert np.allclose(lengths_m(out, 0), lengths_m(take, 0), atol=1e-9)
    with pytest.raises(InputError, match="a cut-off of 40 Hz: expected above 0 and below 27 Hz"):
        edited(take, butterworth_hz=40)


def test_filters_do_not_reach_across_gaps():
    take = with_gap(two_walkers(80), slice(30, 36))
    out = edited(take, butterworth_hz=5)
    alone = edited(take.of_frames(36, 80), butterworth_hz=5)
    assert np.allclose(out.theta[0, 36:], alone.theta[0])
    assert np.array_equal(out.tracked, take.tracked)
    short = edited(with_gap(two_walkers(20), [5]), butterworth_hz=5)
    assert short.provenance["edits"][0]["frames_too_short"] == 5


def sliding_take():
    """Somebody who stands, while what was solved drifts by 6 cm and nods in the knees."""
    shape, frames = person(), 120
    theta = np.zeros((1, frames, 66))
    time_s = np.arange(frames) / 60
    theta[0, :, 0] = 0.03 * np.sin(2 * time_s)
    theta[0, :, 1] = shape.standing_root_height_m - 0.03
    bend = np.arccos(1 - 0.03 / (0.43 + 0.43))
    for side in ("left", "right"):
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_thigh")] = -bend
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_shank")] = 2 * bend
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_foot")] = -bend
    return take_of(theta, [shape], names=("a",))


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_locked_feet_stand_and_legs_keep_their_lengths(strength):
    take = sliding_take()
    assert standing(take, 0, "left").all()
    out = edited(take, foot_lock=strength)
    for side in ("left", "right"):
        foot = PAPER21.bone(f"{side}_foot")
        before, after = (
            np.ptp(t.bone_position_in_world_m[0, :, foot], axis=0) for t in (take, out)
        )
        assert before[0] > 0.05
        assert after[0] == pytest.approx((1 - strength) * before[0], abs=1e-3)
        turn = [t.bone_rotation_in_world_wxyz[0, :, foot] for t in (take, out)]
        assert degrees_apart(*turn) < 1e-3
    assert np.allclose(lengths_m(out, 0), lengths_m(take, 0), atol=1e-9)
    trunk = [PAPER21.bone(name) for name in ("hips", "head", "left_hand")]
    moved = out.bone_position_in_world_m[0][:, trunk] - take.bone_position_in_world_m[0][:, trunk]
    assert np.abs(moved).max() < 1e-9
    assert out.provenance["edits"][0]["stances"] == 2


def test_feet_are_locked_on_the_floor_that_a_shift_brings_them_to():
    raised = edited(sliding_take(), floor_shift_m=0.3)
    assert edited(raised, foot_lock=1.0).provenance["edits"][-1]["stances"] == 0
    both = edited(raised, foot_lock=1.0, floor_shift_m=-0.3)
    assert both.provenance["edits"][-1]["stances"] == 2


def test_a_bar_that_every_frame_is_above_is_refused():
    take = two_walkers(60)
    take = take.with_theta(take.theta, bone_sigma_deg=np.full(take.bone_sigma_deg.shape, 5.0))
    with pytest.raises(InputError, match=r"every frame; the least mean error bar is 5\.0 deg"):
        edited(take, gaps_above_deg=4.0)


def test_a_walk_s_feet_slide_less_and_nothing_jumps():
    shape = person()
    theta = walk(shape, 240)[None]
    take = take_of(theta, [shape], names=("a",))
    out = edited(take, foot_lock=1.0)

    def slide(one):
        total = 0.0
        for side in ("left", "right"):
            place = one.bone_position_in_world_m[0, :, PAPER21.bone(f"{side}_foot")]
            stands = standing(take, 0, side)
            steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
            total += steps[stands[1:] & stands[:-1]].sum()
        return total

    assert slide(out) < 0.1 * slide(take)
    step = np.abs(np.diff(out.bone_position_in_world_m[0], axis=0)).max()
    assert step < 2.0 * np.abs(np.diff(take.bone_position_in_world_m[0], axis=0)).max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"only": ("anne",)}, "no subject 'anne'; did you mean 'anna'"),
        ({"rename": {"bob": "x"}}, "no subject 'bob'"),
        ({"rename": {"ben": "anna"}}, "share a name"),
        ({"start_s": 5.0}, "nothing lies between 5 and inf s: the take goes from 0 to 0.65 s"),
        ({"foot_lock": 2.0}, "foot lock: 2 , expected 0 to 1"),
        ({"fill_gaps_s": float("nan")}, "fill gaps: nan s"),
        ({"floor_shift_m": float("inf")}, "floor shift: inf m"),
        ({}, "no edit was asked for"),
    ],
)
def test_what_makes_no_sense_is_one_line(options, message):
    with pytest.raises((InputError, TakeError), match=message):
        edited(two_walkers(), **options)


def test_the_command_tells_what_it_did_and_keeps_the_take(tmp_path):
    take = with_gap(two_walkers(60), [30, 31])
    path = tmp_path / "t.npz"
    save_take(take, path)
    before = path.read_bytes()
    command = ["edit", str(path), "--only", "anna", "--rename", "anna=Anna", "--trim", "0.1:"]
    command += ["--fill-gaps", "0.1", "--butterworth", "6", "--floor-shift=-1cm", "--json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    out = load_take(tmp_path / "t-edited.npz")
    assert out.subject_names == ("Anna",) and out.tracked.all()
    assert json.loads(result.output)["edits"] == list(out.provenance["edits"])
    assert out.provenance["edits"][-1]["by_m"] == pytest.approx(-0.01)
    assert path.read_bytes() == before
    assert CliRunner().invoke(app, ["edit", str(path), "--trim", "1"]).exit_code == 2
    edit = (tmp_path / "t-edited.npz").read_bytes()
    again = CliRunner().invoke(app, ["edit", str(path), "--only", "ben"])
    assert isinstance(again.exception, InputError) and "an earlier edit" in str(again.exception)
    assert (tmp_path / "t-edited.npz").read_bytes() == edit
    further = ["edit", str(tmp_path / "t-edited.npz"), "--floor-shift", "1cm", "--json"]
    told = json.loads(CliRunner().invoke(app, further).output)["edits"]
    assert [entry["edit"] for entry in told] == ["floor shift"], "only what was done now"
    same = CliRunner().invoke(app, [*command[:4], "--out", str(path)])
    assert isinstance(same.exception, InputError) and "name another file" in str(same.exception)
    assert path.read_bytes() == before


def test_a_name_that_is_given_two_new_ones_is_refused(tmp_path):
    command = ["edit", str(tmp_path / "t.npz"), "--rename", "anna=a", "--rename", "anna=b"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2 and "'anna' is both 'a' and 'b'" in result.output
