"""A session folder with its truth beside it (`truth.npz`), as the simulator writes one."""

from __future__ import annotations

from fusecap.evaluate.score import TakeScore
from fusecap.evaluate.tables import Table


def session_table(score: TakeScore, name: str, *, simulated: bool) -> Table:
    """The whole score of a take, a row per figure."""
    rows: list[tuple[str, float, float | None, float | None, float | None]] = [
        (what, each.mean, each.std, each.median, each.mad)
        for what, each in (
            ("position error mm", score.position_error_mm),
            ("position error to the root mm", score.root_relative_error_mm),
            ("position error after Procrustes mm", score.aligned_error_mm),
            ("orientation error deg", score.orientation_error_deg),
            ("orientation error after Procrustes deg", score.aligned_orientation_error_deg),
            ("axial error deg", score.axial_error_deg),
        )
    ]
    rows += [
        (what, value, None, None, None)
        for what, value in (
            ("acceleration error m/s²", score.acceleration_error_m_s2),
            ("jitter km/s³", score.jitter_km_s3),
            ("jitter of the truth km/s³", score.true_jitter_km_s3),
            ("foot skate m/s", score.foot_skate_m_s),
            ("foot skate of the truth m/s", score.true_foot_skate_m_s),
            ("found % of person-frames", 100.0 * score.found_share),
            ("extra % of person-frames", 100.0 * score.extra_share),
            ("identity switches", float(score.identity_switches)),
            ("IDF1 %", 100.0 * score.idf1),
        )
    ]
    return Table(
        title=f"Session {name}{' (simulated)' if simulated else ''}",
        columns=("figure", "mean", "std", "median", "MAD"),
        rows=tuple(rows),
    )
