"""One subject's motion over time: initialise, warm-start, solve with the instants before, recover.

    update(observation) -> Estimate        the newest instant, first alone, then in its window
    settled(lag_s)      -> Estimate        an instant of the window, as what came since corrects it
    ahead(observation)  -> Estimate        one that pictures have not reached; changes none of these

Time is an argument; an `Estimator` holds no clock or thread, so a recording replays bit for bit and
several subjects can be updated on threads.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from fusecap.believable import (
    MAX_M,
    believable_keypoints,
    believable_points,
    believable_reading,
    checked_moment,
    shaped_numbers,
    tells,
)
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import landmarks_in_world
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.kernels.lie import wrap_pose
from fusecap.solve.body_measure import BodyMeasure
from fusecap.solve.initialize import (
    neutral_pose,
    pose_from_imus,
    pose_from_landmarks,
    poses_from_one_view,
)
from fusecap.solve.options import SolverOptions
from fusecap.solve.pose_solver import ImuSites, Measurements, PoseSolver, Solution
from fusecap.solve.uncertainty import grown, sigmas, turn_shares, unknown
from fusecap.solve.watchdog import FITS, Watchdog
from fusecap.solve.window_solver import WindowSolver
from fusecap.types import Estimate, Observation, Status

_DEFAULT_HEIGHT_M = 1.72
"""Of a person nobody has measured yet."""
_POOR_COST_PER_KEYPOINT = 0.25
"""½ log(1 + s) per keypoint: half the keypoints are about 30 px off (s = 1 at λ = 1e-3 and full
confidence) in a 1920-pixel-wide image."""
_MAX_PREDICTION_S = 0.2
_RESTART_AFTER_NS = 1_000_000_000
_LOST_FACTOR = 2.0
"""Of the cost of an instant alone, or a poor one: beyond it a motion has gone astray."""
_MAX_STEPS = 3
"""Of the window at a new instant; one or two are enough nearly always."""
_ENOUGH_VIEWS = 3
"""To find a pose by each instant alone, for a take to go on from; with fewer some stay wrong for
seconds."""
_NEAR = 2
"""Instants before and after one, that tell noise of a foot from a step; more would be late."""


@dataclass(frozen=True, kw_only=True)
class SubjectModel:
    """What is known about a person before the first instant."""

    name: str
    shape: BodyShape | None = None
    """None: estimated from triangulated landmarks as they come."""
    sites: ImuSites = field(default_factory=ImuSites.none)
    start_m: tuple[float, float] | None = None
    """x, z."""

    def __post_init__(self) -> None:
        if self.start_m is not None:
            x_m, z_m = self.start_m
            if not (abs(x_m) <= MAX_M and abs(z_m) <= MAX_M):
                raise InputError(f"start_m of '{self.name}' is {self.start_m}, expected x, z in m")


class Estimator:
    """Tracks the pose of one subject."""

    def __init__(
        self,
        model: SubjectModel,
        *,
        rig: Rig,
        landmarks: LandmarkSet,
        prior: PosePrior,
        skeleton: Skeleton = PAPER21,
        options: SolverOptions | None = None,
    ) -> None:
        self.model = model
        self.track_id = -1
        """The track that feeds this estimator now."""
        self._rig = rig
        self._landmarks = landmarks
        self._prior = prior
        self._measure = BodyMeasure(skeleton, landmarks) if model.shape is None else None
        shape = model.shape or BodyShape.from_height(skeleton, _DEFAULT_HEIGHT_M)
        self.solver = PoseSolver(
            shape=shape,
            rig=rig,
            landmarks=landmarks,
            prior=prior,
            sites=model.sites,
            options=options,
        )
        self._landmark_bones = landmarks.bones(skeleton)
        together = self.solver.options.together
        self._room = self.solver.options.ahead
        self._motion = (
            WindowSolver(self.solver, self.solver.options.window, ahead=self._room)
            if together
            else None
        )
        self._coming: deque[tuple[Observation, np.ndarray]] = deque(maxlen=max(self._room, 1))
        """Instants `ahead` of the window, and their poses."""
        self._before: deque[tuple[Observation, np.ndarray]] = deque(
            maxlen=self.solver.options.window
        )
        """Seen last, while seeding; a motion begins with these."""
        self._recent: deque[Estimate] = deque(maxlen=self.solver.options.window)
        """Those of the instants in the window, as they were when new."""
        self._turn_shares = turn_shares(skeleton)
        self._sigmas = unknown(skeleton)
        self._measured_ns = 0
        self.found_anew = 0
        """How often the watchdog replaced a pose that had not fitted."""
        self.found_anew_since_ns: int | None = None
        """Of the last instant: since when the replaced pose had not fitted; None: it was not."""
        self._views = np.zeros(len(rig), dtype=bool)
        self._one_view = False
        self._solution: Solution | None = None
        self._previous: Observation | None = None
        self._sites: list[np.ndarray] = []
        self._points: list[tuple[int, np.ndarray]] = []
        self._watchdog = Watchdog()
        self._last_ns = -(1 << 62)

    @property
    def shape(self) -> BodyShape:
        """The body in use now."""
        return self.solver.shape

    def follow(
        self,
        track_id: int,
        observation: Observation,
        landmarks_in_world_m: Float[np.ndarray, "k 3"] | None = None,
    ) -> Estimate | None:
        """`update` for a track; one that was away for a second starts from a fresh first pose."""
        away_ns = checked_moment(observation.timestamp_ns, self._last_ns) - self._last_ns
        self.track_id = track_id
        if self._solution is not None and away_ns > _RESTART_AFTER_NS:
            self.restart()
        return self.update(observation, landmarks_in_world_m)

    def restart(self) -> None:
        """The next pose is a first one; the body stays known."""
        self._solution = None
        self._previous = None
        self._sites = []
        self._points = []
        self._watchdog.reset()
        self._begin_motion()

    def set_shape(self, shape: BodyShape) -> None:
        """Fix the body; it is no longer estimated."""
        self._measure = None
        self.solver.set_shape(shape)

    def predict(self, now_ns: int) -> Float[np.ndarray, "k 3"] | None:
        """Landmarks in the world [m] at `now_ns` by constant velocity; None before the first pose.

        Extrapolation stops after 0.2 s: a person unseen for longer is expected where last seen.
        """
        if not self._points:
            return None
        last_ns, last = self._points[-1]
        if len(self._points) < 2:
            return last
        before_ns, before = self._points[0]
        ahead_s = min((now_ns - last_ns) * 1e-9, _MAX_PREDICTION_S)
        return last + (last - before) * (ahead_s / ((last_ns - before_ns) * 1e-9))

    def update(
        self,
        observation: Observation,
        landmarks_in_world_m: Float[np.ndarray, "k 3"] | None = None,
    ) -> Estimate | None:
        """The pose at this instant; None while nothing allows a first pose.

        `landmarks_in_world_m` (NaN = missing) are triangulated landmarks of this instant: they
        measure the body, place the first pose, and offer a second start when a solve ends badly.
        With neither keypoints nor IMUs the pose is held and its error bars grow. Raises
        `InputError` for arrays of another shape and for a time that is not after the last one,
        with everything as it was before.
        """
        if landmarks_in_world_m is None:
            landmarks_in_world_m = np.full((len(self._landmark_bones), 3), np.nan)
        landmarks_in_world_m = believable_points(landmarks_in_world_m, len(self._landmark_bones))
        observation = self._believed(observation, self._last_ns)
        self._last_ns = observation.timestamp_ns
        self._learn_shape(landmarks_in_world_m)
        data = self._measurements(observation)
        views = np.asarray(np.any(observation.keypoints[:, :, 2] > 0, axis=1))
        has_imu = tells(observation.imu)
        started = time.perf_counter()
        self.found_anew_since_ns = None
        if self._solution is None:
            solution = self._first(observation, data, landmarks_in_world_m, self.model.start_m)
        elif views.any() or has_imu:
            theta = self._solution.theta
            near = self.solver.solve(theta, self._weighed(data, theta))
            solution = self._watched(observation, data, landmarks_in_world_m, near)
            if solution is not near:
                self._begin_motion()
        else:
            return self._held(observation.timestamp_ns, self._solution, views)
        if solution is None:
            return None
        sound = solution.status is not Status.DIVERGED
        seeding = self.solver.options.seeding
        if self._motion is not None and sound:
            if seeding and np.count_nonzero(views) >= _ENOUGH_VIEWS:
                self._motion.reset()
                self._before.append((observation, solution.theta))
            else:
                while self._before:
                    self._motion.push(*self._before.popleft())
                solution = self._in_window(self._motion, observation, data, solution)
        solve_s = time.perf_counter() - started
        self._remember(observation, solution)
        if not seeding:
            self._one_view = bool(np.count_nonzero(views) == 1) and not has_imu
            spread = self._spread()
            self._sigmas = sigmas(*spread, self._turn_shares, one_view=self._one_view)
        self._views = views
        estimate = self._estimate(
            observation.timestamp_ns,
            solution,
            views,
            solve_s,
            measured=bool(views.any()) or has_imu,
        )
        self._measured_ns = observation.timestamp_ns
        if sound:
            self._recent.append(estimate)
        return estimate

    def _believed(self, observation: Observation, last_ns: int) -> Observation:
        imu, shape = observation.imu, (*self.solver.view_shape, 3)
        return Observation(
            timestamp_ns=checked_moment(observation.timestamp_ns, last_ns),
            keypoints=believable_keypoints(
                shaped_numbers(observation.keypoints, shape, "keypoints")
            ),
            imu=None if imu is None else believable_reading(imu, len(self.model.sites.bone)),
        )

    def settled(self, lag_s: float) -> Estimate | None:
        """The newest instant at least `lag_s` old, corrected by what was measured since.

        None while the window holds none that is so old; one of less than `lag_s` settles as much
        as it can.
        """
        if self._motion is None or not self._motion.count:
            return None
        back = self._motion.back(lag_s)
        if back is None or back >= len(self._recent):
            return None
        then = self._recent[-1 - back]
        theta = self._motion.pose(back)
        position, rotation = self.solver.posed(theta)
        return replace(
            then, theta=theta, bone_position_in_world_m=position, bone_rotation_in_world=rotation
        )

    def ahead(self, observation: Observation) -> Estimate | None:
        """The pose at an instant that pictures have not reached: from sensors, and as it goes on.

        `update` at that instant, or one before, corrects it; nothing else depends on it. None
        before there is a motion to go on from. Raises `InputError` as `update` does.
        """
        motion = self._motion
        if motion is None or self._solution is None or not motion.count:
            return None
        while self._coming and self._coming[0][0].timestamp_ns <= self._last_ns:
            self._coming.popleft()
        last = self._coming[-1] if self._coming else None
        observation = self._believed(observation, last[0].timestamp_ns if last else self._last_ns)
        self._coming.append((observation, last[1] if last else motion.pose()))
        if not motion.goes_on(self._coming[0][0].timestamp_ns):
            return None
        started = time.perf_counter()
        found = motion.ahead(self._coming, _MAX_STEPS)
        if not np.isfinite(found.theta).all():
            self._coming.clear()
            return None
        for row, theta in enumerate(found.theta):
            self._coming[row] = (self._coming[row][0], theta)
        theta = found.theta[-1].copy()
        wrap_pose(theta)
        position, rotation = self.solver.posed(theta)
        bars = sigmas(found.turn_rad2, found.place_m2, self._turn_shares, one_view=self._one_view)
        return replace(
            self._estimate(
                observation.timestamp_ns,
                self._solution,
                self._views,
                time.perf_counter() - started,
                measured=tells(observation.imu),
            ),
            theta=theta,
            bone_position_in_world_m=position,
            bone_rotation_in_world=rotation,
            bone_sigma_deg=bars.bone_deg,
            position_sigma_m=bars.position_m,
        )

    def _in_window(
        self,
        motion: WindowSolver,
        observation: Observation,
        data: Measurements,
        alone: Solution,
    ) -> Solution:
        """The instant together with those before it; alone where the motion has lost the person."""
        if not motion.goes_on(observation.timestamp_ns):
            self._begin_motion()
        motion.push(observation, alone.theta)
        motion.stand(motion.count - 1 - _NEAR, _NEAR)
        motion.refine(_MAX_STEPS)
        theta = motion.pose()
        data = self._weighed(data, alone.theta)
        seen = np.count_nonzero(observation.keypoints[:, :, 2] > 0)
        allowed = _LOST_FACTOR * max(alone.cost, _POOR_COST_PER_KEYPOINT * max(seen, 1))
        if not self.solver.cost(theta, data) < allowed:
            self._begin_motion()
            motion.push(observation, alone.theta)
            return alone
        position, rotation = self.solver.posed(theta)
        return replace(alone, theta=theta, position_in_world_m=position, rotation_in_world=rotation)

    def _spread(self) -> tuple[np.ndarray, np.ndarray]:
        if self._motion is not None and self._motion.count > 2:
            return self._motion.newest_spread()
        return self.solver.spread()

    def _begin_motion(self) -> None:
        """Forget how the person moved so far."""
        self._recent.clear()
        self._before.clear()
        self._coming.clear()
        if self._motion is not None:
            self._motion.reset()

    def _first(
        self,
        observation: Observation,
        data: Measurements,
        points: np.ndarray,
        place_m: tuple[float, float] | None,
    ) -> Solution | None:
        """From nothing but this instant, and where (x, z) somebody is, if that is known.

        `data` are as measured, not weighed: each start has its own distances.
        """
        shape, prior, sites = self.solver.shape, self._prior, self.model.sites
        starts = []
        from_points = pose_from_landmarks(
            shape, self._landmarks, prior, points, sites, data.imu_rotation
        )
        if from_points is not None:
            starts = [from_points]
        elif place_m is not None or not (observation.keypoints[:, :, 2] > 0).any():
            x_m, z_m = place_m or (0.0, 0.0)
            from_imus = pose_from_imus(shape, prior, sites, data.imu_rotation, x_m=x_m, z_m=z_m)
            if from_imus is not None:
                starts = [from_imus]
            elif (observation.keypoints[:, :, 2] > 0).any():
                starts = [
                    neutral_pose(shape, prior, x_m=x_m, z_m=z_m, heading_rad=heading)
                    for heading in np.arange(8) * np.pi / 4
                ]
        else:
            starts = poses_from_one_view(shape, prior, self._rig, observation.keypoints)
        solutions = [self.solver.solve(start, self._weighed(data, start)) for start in starts]
        solutions = [s for s in solutions if np.isfinite(s.theta).all() and s.cost < np.inf]
        return min(solutions, key=lambda s: s.cost) if solutions else None

    def _watched(
        self, observation: Observation, data: Measurements, points: np.ndarray, found: Solution
    ) -> Solution:
        """`found`, or a pose found anew, where it has not fitted for a while and that fits."""
        now_ns = observation.timestamp_ns
        seen = int(np.count_nonzero(observation.keypoints[:, :, 2] > 0))
        if not self._watchdog.doubts(found.cost, seen, now_ns):
            return found
        x_m, z_m = found.theta[[0, 2]].tolist()
        other = self._first(observation, data, points, (x_m, z_m))
        # The solver's posed body and matrices belong to its last solve, but results are copies.
        # A cost that is no number fits nothing.
        fits = other is not None and not other.cost >= FITS * found.cost
        since_ns = self._watchdog.tried(fits, now_ns)
        if other is None or since_ns is None:
            return found
        self.found_anew_since_ns = since_ns
        self.found_anew += 1
        return other

    def _learn_shape(self, points: np.ndarray) -> None:
        if self._measure is None:
            return
        self._measure.add(points)
        shape = self._measure.shape()
        if shape is not None and shape is not self.shape:
            self.solver.set_shape(shape)

    def _weighed(self, data: Measurements, theta: np.ndarray) -> Measurements:
        return replace(data, keypoints=self.solver.weighed(data.keypoints, theta[:3]))

    def _measurements(self, observation: Observation) -> Measurements:
        count = len(self.model.sites.bone)
        rotation = np.full((count, 3, 3), np.nan)
        accel = np.full((count, 3), np.nan)
        history = np.full((2, count, 3), np.nan)
        dt_s = 1.0
        if observation.imu is not None:
            rotation = np.ascontiguousarray(observation.imu.bone_rotation_in_world)
        if self._previous is not None:
            dt_s = (observation.timestamp_ns - self._previous.timestamp_ns) * 1e-9
            if self._previous.imu is not None and len(self._sites) == 2:
                accel = np.ascontiguousarray(self._previous.imu.accel_in_world_m_s2)
                history = np.stack([self._sites[1], self._sites[0]])
        return Measurements(
            keypoints=np.ascontiguousarray(observation.keypoints),
            imu_rotation=rotation,
            imu_accel=accel,
            imu_history=history,
            dt_s=dt_s,
        )

    def _remember(self, observation: Observation, solution: Solution) -> None:
        position, rotation = solution.position_in_world_m, solution.rotation_in_world
        bones = list(self.model.sites.bone)
        site = position[bones] + np.einsum(
            "iab,ib->ia", rotation[bones], self.model.sites.position_m
        )
        points = landmarks_in_world(
            position[None], rotation[None], self._landmark_bones, self.solver.landmark_offsets_m
        )[0]
        self._previous = observation
        self._sites = [*self._sites[-1:], site]
        self._points = [*self._points[-2:], (observation.timestamp_ns, points)]
        self._solution = solution

    def _held(self, timestamp_ns: int, last: Solution, views: np.ndarray) -> Estimate:
        """The last pose again; accelerations must not reach across the gap."""
        self._sites = []
        known = self._sigmas
        self._sigmas = grown(known, (timestamp_ns - self._measured_ns) * 1e-9)
        held = self._estimate(timestamp_ns, last, views, 0.0, measured=False)
        self._sigmas = known
        return held

    def _estimate(
        self,
        timestamp_ns: int,
        solution: Solution,
        views: Bool[np.ndarray, " c"],
        solve_s: float,
        *,
        measured: bool,
    ) -> Estimate:
        return Estimate(
            track_id=self.track_id,
            name=self.model.name,
            timestamp_ns=timestamp_ns,
            theta=solution.theta,
            bone_position_in_world_m=solution.position_in_world_m,
            bone_rotation_in_world=solution.rotation_in_world,
            bone_sigma_deg=self._sigmas.bone_deg,
            position_sigma_m=self._sigmas.position_m,
            shape=self.solver.shape,
            status=solution.status,
            iterations=solution.iterations,
            cost=solution.cost,
            solve_s=solve_s,
            views=views,
            measured=measured,
        )
