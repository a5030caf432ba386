"""Own detections in, poses out to a WebSocket: the pipeline in an application's own loop.

    python examples/1_own_detections.py [ws://127.0.0.1:8765]

The application has calibrated cameras and a detector. At every instant it hands over everyone whom
each camera shows, in any order and without names; people are told apart, measured, solved and sent.
Here the simulated demo scene stands for cameras and detector.
"""

import sys

import numpy as np

import fusecap
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.streams.person_pose import StreamFrame, pose_of_estimate
from fusecap.streams.stream import open_stream
from fusecap.streams.target import parse_target

scene = demo_scene(seconds=2.0)
rig = fusecap.Rig(
    cameras=tuple(
        fusecap.Camera(
            name=camera.name,
            size_px=camera.size_px,
            matrix=camera.matrix,
            distortion=camera.distortion,
            rotation=camera.rotation,
            translation=camera.translation,
        )
        for camera in scene.rig.cameras
    )
)
setup = fusecap.Setup(
    rig=rig,
    landmarks=fusecap.landmark_set_named("body25"),
    skeleton=fusecap.PAPER21,
    prior=fusecap.load_prior(fusecap.PAPER21),
    rate_hz=60.0,
    tracker=fusecap.TrackerOptions(max_subjects=2, volume_m=scene.volume_m),
)
pipeline = fusecap.Pipeline(setup)
target = parse_target(sys.argv[1] if len(sys.argv) > 1 else "ws")
stream = open_stream(target, {}, setup.rate_hz)

names: set[str] = set()
errors_mm: dict[str, list[float]] = {}
for instant, seen in enumerate(scene.detections):
    detections = fusecap.Detections(
        timestamp_ns=round(instant * 1e9 / setup.rate_hz),
        people=seen.people,  # per camera (people, 25, 3): x, y [px] and confidence
    )
    estimates = pipeline.step(detections, readings={}).estimates

    people = {estimate.name: pose_of_estimate(estimate) for estimate in estimates}
    if set(people) != names:
        names = set(people)
        stream.set_cast({name: pose.shape for name, pose in people.items()})
    frame = StreamFrame(
        time_s=instant / setup.rate_hz, timestamp_ns=detections.timestamp_ns, people=people
    )
    stream.send(frame)

    for estimate in estimates:
        truth_m = scene.truth.bone_position_in_world_m[:, instant]
        distance_m = np.linalg.norm(estimate.bone_position_in_world_m - truth_m, axis=2)
        nearest_mm = 1e3 * distance_m.mean(axis=1).min()
        errors_mm.setdefault(estimate.name, []).append(nearest_mm)
stream.close()

for name, each_mm in errors_mm.items():
    print(f"{name}: {len(each_mm)} poses, mean joint position error {np.mean(each_mm):.1f} mm")
