"""A session folder with its truth beside it (`truth.npz`), as the simulator writes one."""

from __future__ import annotations

from fusecap.evaluate.score import score_take
from fusecap.evaluate.tables import Table
from fusecap.take import Take


def session_table(take: Take, truth: Take, name: str) -> Table:
    """The whole score of a take, a row per figure."""
    score = score_take(take, truth)
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
            ("found % of person-frames", 100.0 * score.found_share),
            ("extra % of person-frames", 100.0 * score.extra_share),
            ("identity switches", float(score.identity_switches)),
            ("IDF1 %", 100.0 * score.idf1),
        )
    ]
    simulated = bool(truth.provenance.get("simulated"))
    return Table(
        title=f"Session {name}{' (simulated)' if simulated else ''}",
        columns=("figure", "mean", "std", "median", "MAD"),
        rows=tuple(rows),
    )
