"""Own cost term: what is known of somebody, beside what cameras and sensors say.

    python examples/5_own_cost_term.py

Every quadratic term on the pose is a prior: along the columns of its basis, the pose costs its
squared distance from the mean, in units of sigma. Here somebody wears a splint, so the left knee
is straight, give or take 2 degrees. A term with measurements of its own is a kernel:
docs/architecture.md lists the places it has. The scene is the simulated demo, where nobody wears a
splint: the term pulls its knee straight, against what all cameras see.
"""

import numpy as np

import fusecap
from fusecap.evaluate.demo_scene import demo_scene

SKELETON = fusecap.PAPER21
KNEE = SKELETON.bone("left_shank")


def with_splint(prior: fusecap.PosePrior, sigma_deg: float) -> fusecap.PosePrior:
    """The same, and the left knee straight: its three angles are directions of their own."""
    angles = slice(3 * (KNEE - 1), 3 * KNEE)  # of theta[6:]
    splint = np.zeros((len(prior.mean), 3))
    splint[angles] = np.eye(3)
    mean = prior.mean.copy()
    mean[angles] = 0.0
    basis, _ = np.linalg.qr(np.hstack([splint, prior.basis]))  # orthonormal, the splint first
    sigma = np.concatenate([np.full(3, np.radians(sigma_deg)), prior.sigma])
    return fusecap.PosePrior(
        skeleton_name=prior.skeleton_name,
        mean=mean,
        basis=basis,
        sigma=sigma,
        acceleration=prior.acceleration,
        recipe={**prior.recipe, "splint": "left knee"},
    )


def knee_deg(prior: fusecap.PosePrior) -> float:
    """Mean turn of the first person's left knee in the demo."""
    scene = demo_scene(seconds=1.0)
    pipeline = fusecap.Pipeline(
        fusecap.Setup(
            rig=scene.rig,
            landmarks=scene.landmark_set,
            skeleton=SKELETON,
            prior=prior,
            rate_hz=60.0,
            tracker=fusecap.TrackerOptions(max_subjects=2, volume_m=scene.volume_m),
        )
    )
    turns = [
        np.linalg.norm(estimate.theta[6:].reshape(-1, 3)[KNEE - 1])
        for seen in scene.detections
        for estimate in pipeline.step(seen, readings={}).estimates[:1]
    ]
    return float(np.degrees(np.mean(turns)))


usual = fusecap.load_prior(SKELETON)
bent_deg, straight_deg = knee_deg(usual), knee_deg(with_splint(usual, 2.0))
print(f"left knee bent by {bent_deg:.0f} deg, with a splint {straight_deg:.0f} deg")
