"""What is plotted over time: a curve per person, with a line at the present."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot
from jaxtyping import Float, Int

from fusecap.take import Take
from fusecap.viewer.palette import Rgb, css

ALL_BONES = "all bones (mean)"
_POINTS = 400
"""Of a drawn curve; a plot is about as many pixels wide."""
_HEIGHT_PX = 170


def drawn(frames: Int[np.ndarray, " t"]) -> Int[np.ndarray, " n"]:
    """Those of them that a curve is drawn of, evenly."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, min(_POINTS, len(frames))).astype(int))]


@dataclass(frozen=True, slots=True, kw_only=True)
class BoneCurve:
    """One value per bone and instant, for each person."""

    title: str
    """With its unit."""
    time_s: Float[np.ndarray, " n"]
    """As the take counts."""
    by_person: Mapping[str, Float[np.ndarray, "n b"]]
    """NaN where there is none."""
    top: float | None = None
    """Of the axis; None: of the data."""


def sigma_curve(take: Take, time_s: Float[np.ndarray, " n"]) -> BoneCurve:
    """How sure each bone's rotation is."""
    return BoneCurve(
        title="expected bone error (deg)",
        time_s=time_s,
        by_person=dict(zip(take.subject_names, take.bone_sigma_deg, strict=True)),
    )


class Plot:
    """A curve on a page."""

    def __init__(
        self,
        gui: viser.GuiApi,
        curve: BoneCurve,
        bone_names: Sequence[str],
        colours: Mapping[str, Rgb],
    ) -> None:
        self._curve = curve
        self._bone_names = list(bone_names)
        self._time_s = curve.time_s
        self._drawn = self._data(ALL_BONES)
        self._now = -1
        self._handle = gui.add_uplot(
            self._with_now(0),
            (
                viser.uplot.Series(label="time (s)"),
                *(
                    viser.uplot.Series(label=name, stroke=css(colours[name]), width=1.6)
                    for name in curve.by_person
                ),
                viser.uplot.Series(label="now", stroke="#333333", width=1.0),
            ),
            title=curve.title,
            scales={
                "x": viser.uplot.Scale(time=False),
                "y": viser.uplot.Scale(range=(0.0, self._top())),
            },
            legend=viser.uplot.Legend(show=False),
            height=_HEIGHT_PX,
        )

    def choose(self, bone: str) -> None:
        """One bone, or the mean of all."""
        self._drawn = self._data(bone)
        self._handle.scales = {
            "x": viser.uplot.Scale(time=False),
            "y": viser.uplot.Scale(range=(0.0, self._top())),
        }
        self._handle.data = self._with_now(max(self._now, 0))

    def mark(self, time_s: float) -> None:
        """The present."""
        now = min(int(np.searchsorted(self._time_s, time_s)), len(self._time_s) - 1)
        if now != self._now:
            self._now = now
            self._handle.data = self._with_now(now)

    def _data(self, bone: str) -> list[Float[np.ndarray, " n"]]:
        lines = []
        for values in self._curve.by_person.values():
            if bone == ALL_BONES:
                there = np.isfinite(values)
                total = np.where(there, values, 0.0).sum(axis=1)
                count = there.sum(axis=1)
                lines.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
            else:
                lines.append(values[:, self._bone_names.index(bone)])
        return lines

    def _top(self) -> float:
        if self._curve.top is not None:
            return self._curve.top
        values = np.concatenate([*self._drawn, [0.0]])
        return float(1.05 * np.nanmax(values)) or 1.0

    def _with_now(self, row: int) -> tuple[Float[np.ndarray, " n"], ...]:
        """The present as a line from one point to the next, which is less than a pixel away."""
        line = np.full(len(self._time_s), np.nan)
        line[row] = 0.0
        line[row - 1 if row == len(line) - 1 else row + 1] = self._top()
        return (self._time_s, *self._drawn, line)
