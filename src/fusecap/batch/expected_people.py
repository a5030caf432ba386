"""Where people are expected in each view of a recording before its next picture is looked at.

With calibrated cameras the whole pipeline runs along (`fusecap.engine.expected`); without a
calibration everyone is expected where they were.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fusecap.engine.expected import expected_people
from fusecap.pipeline import Pipeline, Step
from fusecap.setup import Scene
from fusecap.types import Detections

_HELD_PERIODS = 1.01
"""Frame periods for which a view's last detections stand for it between its frames."""


class ExpectedPeople:
    """Learns from each instant's detections where people will be at the next."""

    def __init__(
        self, scene: Scene | None, *, periods_s: Sequence[float], landmark_count: int
    ) -> None:
        """`periods_s` are the cameras' frame periods, in the order of the scene's rig."""
        self._scene = scene
        self._pipeline = None if scene is None else _pipeline(scene)
        self._hold_ns = [round(_HELD_PERIODS * period_s * 1e9) for period_s in periods_s]
        self._nobody = np.empty((0, landmark_count, 3))
        self._people = [self._nobody] * len(periods_s)
        self._seen_ns = [0] * len(periods_s)
        self._step = Step(updates=(), estimates=())

    def at(self, now_ns: int) -> list[Float[np.ndarray, "m k 3"]]:
        """Per camera the people expected at `now_ns`: x, y [px], confidence; NaN, NaN, 0 unknown.

        Projections may lie outside the image.
        """
        if self._scene is None or self._pipeline is None:
            return self._people
        return expected_people(self._scene.rig, self._pipeline, self._step, self._people, now_ns)

    def learn(self, now_ns: int, people: Sequence[Float[np.ndarray, "n k 3"] | None]) -> None:
        """Per camera who was seen at `now_ns`; None where it had no picture."""
        for index, some in enumerate(people):
            if some is not None:
                self._people[index], self._seen_ns[index] = some, now_ns
            elif now_ns - self._seen_ns[index] > self._hold_ns[index]:
                self._people[index] = self._nobody
        if self._pipeline is not None:
            detections = Detections(timestamp_ns=now_ns, people=tuple(self._people))
            self._step = self._pipeline.step(detections, {})


def _pipeline(scene: Scene) -> Pipeline:
    return Pipeline(
        rig=scene.rig,
        landmarks=scene.landmarks,
        skeleton=scene.skeleton,
        prior=scene.prior,
        sorter=scene.sorter,
        subjects=scene.subjects,
        options=scene.options,
    )
