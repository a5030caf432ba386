"""Video files: whether they open, how long they are, how fast."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fusecap.errors import FusecapError
from fusecap.findings import Findings
from fusecap.sources.video import Video, VideoInfo

UNEQUAL_S = 0.5


def check_videos(videos: Mapping[str, Path], findings: Findings) -> dict[str, VideoInfo]:
    """Per camera that can be read what its video is."""
    infos: dict[str, VideoInfo] = {}
    for name, path in videos.items():
        if not path.is_file():
            continue
        try:
            infos[name] = Video(path).info
        except FusecapError as error:
            findings.add("error", f"camera '{name}'", str(error))
    for name, info in infos.items():
        if info.is_variable_rate:
            findings.add(
                "info",
                f"camera '{name}'",
                f"records at a variable rate, {info.rate_hz:.1f} Hz on average",
                "the file's own times are used; do not set rate_hz",
            )
    if len(infos) > 1:
        shortest = min(infos, key=lambda name: infos[name].duration_s)
        longest = max(infos, key=lambda name: infos[name].duration_s)
        if infos[longest].duration_s - infos[shortest].duration_s > UNEQUAL_S:
            findings.add(
                "warning",
                "videos",
                f"differ in length: '{shortest}' {infos[shortest].duration_s:.2f} s, "
                f"'{longest}' {infos[longest].duration_s:.2f} s",
                "they were started or stopped apart: fusecap calibrate sync",
            )
    return infos
