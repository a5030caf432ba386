"""Who turned out to be somebody else than was followed: names and numbers are put right.

By sensors, by a trait of the body, by the way somebody was going. What comes back is, by the id
that a track had, the one it has then. Last, whom sensors contradict though nobody fits them better.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import numpy as np

from fusecap.associate.matching import cheapest
from fusecap.associate.options import TrackerOptions
from fusecap.associate.sensor_vote import FITS, MARGIN, SOON_S, SURE_S, SensorVote
from fusecap.associate.subjects import Cast
from fusecap.associate.track import Track
from fusecap.associate.traits import Kind, exchange, exchanged


def pair_anew(cast: Cast, tracks: Sequence[Track], vote: SensorVote, now_ns: int) -> dict[int, int]:
    """Give wearers the tracks that their sensors fit, where these are clearly others.

    Everyone who is tracked may be who wears them, and a wearer may be nobody of these: the
    place then waits, as one whom nobody fits does. The identity stays with the place, so who is
    followed under it must be solved anew. Returns, by the id that a track had, the one it has.
    """
    worn = [p for p in cast.places if p.name in vote.heard]
    cost = np.array([[vote.misfit(t, p.name, SURE_S) for t in tracks] for p in worn])
    now = [tracks.index(p.track) if p.live and p.track in tracks else -1 for p in worn]
    told = [row for row, t in enumerate(now) if t < 0 or np.isfinite(cost[row, t])]
    if not told or not tracks:
        return {}
    unknown = [t for row, t in enumerate(now) if row not in told]
    cost[:, unknown] = np.inf
    strangers = [t not in [track for _, track in cast.followed()] for t in tracks]
    # Who is not followed takes somebody's track only if it can be no other; see `Admission`.
    lost = np.flatnonzero(np.array(now) < 0)
    least = np.fmin.reduce(cost[lost], axis=1, initial=np.inf)[:, None]
    alike = (cost[lost] < least + MARGIN).sum(axis=1) > 1
    rivals = (cost[lost] < FITS).sum(axis=0) > 1
    cost[lost] = np.where(alike[:, None] | rivals | np.array(strangers), np.inf, cost[lost])
    nobody = np.full((len(told), len(told)), FITS)
    choice = np.concatenate([np.where(cost < FITS, cost, np.inf)[told], nobody], axis=1)
    best = {told[r]: c if c < len(tracks) else -1 for r, c in cheapest(choice)}
    moves = {row: t for row, t in best.items() if t != now[row]}
    moves = {row: t for row, t in moves.items() if t >= 0 or now[row] in moves.values()}
    gain = sum(
        (cost[row, now[row]] if now[row] >= 0 else FITS) - (cost[row, t] if t >= 0 else FITS)
        for row, t in moves.items()
    )
    if not moves or gain < MARGIN * len(moves):
        return {}
    given = {worn[row].name: tracks[t] for row, t in moves.items() if t >= 0}
    left = [worn[row] for row, t in moves.items() if t < 0]
    known = {p.name: deepcopy(p.track.traits) for p in cast.places if p.track}
    renumbered = cast.give(given, left, now_ns)
    for name, track in given.items():
        track.continues(known.get(name, {}), now_ns)
    return renumbered


def part_by(
    cast: Cast, kind: Kind, tracks: Sequence[Track], now_ns: int, vote: SensorVote
) -> tuple[dict[int, int], int]:
    """Put right who came out of an overlap exchanged, as a trait shows; wearers are not asked.

    Returns what `pair_anew` does, and since when it has been so [ns].
    """
    worn = [p.track for p in cast.places if p.live and p.name in vote.lately]
    seen = [t for t in tracks if t.seen_ns == now_ns and t not in worn]
    moves = exchanged(kind, seen, now_ns)
    if not moves:
        return {}, now_ns
    since_ns = min(t.traits[kind.name].alone_ns for t in moves)
    body_of = {person: body for body, person in moves.items()}
    exchange(moves)
    places = [p for p in cast.places if p.live and p.track in body_of]
    given = {p.name: body_of[p.track] for p in places if p.track}
    return cast.give(given, (), now_ns), since_ns


def return_to_way(
    cast: Cast, tracks: Sequence[Track], vote: SensorVote, now_ns: int, options: TrackerOptions
) -> tuple[dict[int, int], int | None]:
    """Follow whoever goes on where a subject was expected, not whom its track jumped to.

    A track that left its way (`Track.fork`) may have been given somebody else's detections
    while the subject had none; the subject then comes as a newcomer. Returns, by the id that a
    track had, the one it has, and since when.
    """
    subjects = cast.ids()
    newcomers = [t for t in tracks if t.track_id not in subjects and cast.may_enter(t, now_ns)]
    for place in cast.places:
        track = place.track
        if not place.live or track is None or track.fork is None:
            continue
        if vote.misfit(track, place.name, SOON_S) < FITS:
            continue
        fork, best = track.fork, None
        nearest_m = fork.jump_m - options.candidates.consistency_m
        for other in newcomers:
            after_s = (other.born_ns - fork.at_ns) * 1e-9
            away_m = fork.away_m(other.born_m, other.born_ns)
            if 0.0 <= after_s <= options.doubt_s and away_m < nearest_m:
                best, nearest_m = other, away_m
        if best is not None:
            former, own = best.track_id, track.track_id
            track.exchange(best)
            place.track = best
            return {former: own, own: former}, fork.at_ns
    return {}, None


def contradicted(cast: Cast, vote: SensorVote, now_ns: int, options: TrackerOptions) -> list[str]:
    """Wearers whom their sensors have not fitted for `patience_s`; each is named once."""
    found = []
    for place in cast.places:
        track = place.track if place.live else None
        misfit = vote.misfit(track, place.name, SURE_S) if track else np.nan
        if misfit < FITS:
            place.misfit_since_ns, place.told = None, False
        elif np.isfinite(misfit):
            if place.misfit_since_ns is None:
                place.misfit_since_ns = now_ns
            for_s = (now_ns - place.misfit_since_ns) * 1e-9
            if for_s >= options.patience_s and not place.told:
                place.told = True
                found.append(place.name)
    return found
