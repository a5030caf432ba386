"""Cameras that are synchronised with nothing: their samples in, everyone at one instant out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusecap.believable import believable_keypoints
from fusecap.engine.samples import Samples
from fusecap.sources.synchronizer import EXACT_S, Frame, ViewOfPeople, detections_of, seen_amid
from fusecap.types import CameraSample, Detections

LOOKING_S, LOOKING_PERIODS = 0.5, 3.0
"""A camera looks while its newest sample is not older than both: a few lost frames are no outage,
and half a second without a picture says nothing about who is there."""
_EXACT_NS = round(EXACT_S * 1e9)


class Cameras:
    """The latest samples of every camera, interpolated on demand."""

    def __init__(self, rates_hz: Sequence[float], landmark_count: int) -> None:
        """`rates_hz` are used until a camera has shown its own rate."""
        self._samples = [Samples[ViewOfPeople]() for _ in rates_hz]
        self._periods_s = [1.0 / rate_hz for rate_hz in rates_hz]
        self._nobody = np.empty((0, landmark_count, 3))

    def take(self, sample: CameraSample) -> None:
        """Keep a sample; one of no camera or of other keypoints is left out."""
        people = sample.people
        known = 0 <= sample.camera < len(self._samples)
        if not known or people.ndim != 3 or people.shape[1:] != self._nobody.shape[1:]:
            return
        looks = sample.appearance
        if looks is not None and len(looks) != len(people):
            looks = None
        seen = ViewOfPeople(believable_keypoints(people), looks)
        self._samples[sample.camera].insert(sample.timestamp_ns, seen)

    def detections(self, now_ns: int) -> Detections:
        """Everyone at an instant, and which cameras looked."""
        views, looked = [], []
        for camera, samples in enumerate(self._samples):
            samples.forget_before(now_ns)
            before, after = samples.around(now_ns, _EXACT_NS)
            found = seen_amid(
                _frame(samples, before, now_ns),
                _frame(samples, after, now_ns),
                0.0,
                period_s=self._period_s(camera, now_ns),
            )
            views.append(ViewOfPeople(self._nobody) if found is None else found)
            looked.append(self.looks(camera, now_ns))
        return detections_of(now_ns, views, tuple(looked))

    def looks(self, camera: int, now_ns: int) -> bool:
        """Whether the camera delivered shortly before an instant, or at it."""
        longest_s = max(LOOKING_S, LOOKING_PERIODS * self._period_s(camera, now_ns))
        last_ns = self._samples[camera].last_ns(now_ns + _EXACT_NS)
        return (now_ns - last_ns) * 1e-9 <= longest_s

    def waiting(self, now_ns: int) -> list[bool]:
        """Per camera that looks, whether a sample from the instant or later is still to come."""
        return [
            samples.newest_ns < now_ns
            for camera, samples in enumerate(self._samples)
            if self.looks(camera, now_ns)
        ]

    def _period_s(self, camera: int, now_ns: int) -> float:
        return self._samples[camera].period_s(now_ns) or self._periods_s[camera]


def _frame(samples: Samples[ViewOfPeople], index: int, now_ns: int) -> Frame | None:
    """A sample with its time counted from the instant."""
    if not 0 <= index < len(samples):
        return None
    timestamp_ns, seen = samples.at(index)
    return (timestamp_ns - now_ns) * 1e-9, seen
