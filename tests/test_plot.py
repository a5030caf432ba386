from dataclasses import replace

import numpy as np

from fusecap.exports.plot import plot_take
from motions import person, take_of, walk


def test_picture_shows_tracked_people_and_leaves_out_the_others(tmp_path):
    theta = np.stack([walk(person(), 4), walk(person(), 4)])
    take = take_of(theta, [person(), person()], names=("anna", "ben"))
    tracked = take.tracked.copy()
    tracked[1, 1:] = False
    tracked[0, 3] = False
    plot_take(replace(take, tracked=tracked), [0, 1, 3], tmp_path / "new" / "take.png")
    assert (tmp_path / "new" / "take.png").read_bytes().startswith(b"\x89PNG")
