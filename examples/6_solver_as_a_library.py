"""The solver on its own: one observation in, one pose out.

    python examples/6_solver_as_a_library.py

Feeds the first seconds of the simulated demo scene to an `Estimator`, one instant at a time, as an
application with its own cameras and tracker would.
"""

import numpy as np

import fusecap
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.geometry.triangulation import triangulate

scene = demo_scene(seconds=2.0)
anna = scene.subjects[0]
estimator = fusecap.Estimator(
    fusecap.SubjectModel(name=anna.name, shape=anna.shape),
    rig=scene.rig,
    landmarks=scene.landmark_set,
    prior=fusecap.load_prior(fusecap.PAPER21),
)

errors_mm = []
for instant, detections in enumerate(scene.detections):
    keypoints = np.zeros((len(scene.rig), len(scene.landmark_set.landmark_names), 3))
    for camera, whose in enumerate(scene.detected_person[instant]):
        for person in np.flatnonzero(whose == 0):
            keypoints[camera] = detections.people[camera][person]
    observation = fusecap.Observation(timestamp_ns=detections.timestamp_ns, keypoints=keypoints)
    landmarks_in_world_m, _ = triangulate(scene.rig, keypoints)
    estimate = estimator.update(observation, landmarks_in_world_m)
    if estimate is not None:
        truth_m = scene.truth.bone_position_in_world_m[0, instant]
        distance_m = np.linalg.norm(estimate.bone_position_in_world_m - truth_m, axis=1)
        errors_mm.append(1e3 * distance_m.mean())

print(f"{len(errors_mm)} poses from four cameras, no IMU (simulated)")
print(f"mean joint position error {np.mean(errors_mm):.1f} mm")
