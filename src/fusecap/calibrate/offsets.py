"""Where a detector's keypoints lie on the body: landmark offsets, eq. 17-18 of the paper.

Per instant, person and landmark the keypoints of all views are triangulated (eq. 17, confidence-
weighted and robust: `fusecap.geometry.triangulation`) and brought into the frame of the landmark's
bone by a known pose (eq. 18). The offset is the median of each axis. Samples are divided by the
person's stature before they are pooled, so that one table serves everyone.

**With truth** (`offsets_from_poses`) the pose comes from a take that something better than the
keypoints has made. Every axis of every landmark is then observed, and nothing is assumed.

**Without truth** (`self_calibrate`) the pose comes from a solve that itself followed the keypoints:

    solve with the offsets  ->  eq. 17-18 with the solved poses  ->  a step of the offsets  ->  ...

Each solve pulls the bones towards the keypoints, so eq. 18 shows only the part of a wrong offset
that poses, bone lengths, prior and IMUs could not absorb; the rounds recover more of it. Some of it
they never can: all landmarks moved alike are a moved person, and a knee moved along the thigh is a
longer thigh. Left alone, such directions drift. Four things hold them:

- *Prior.* Offsets are pulled to the defaults as by a normal distribution about them, narrow
  (`JOINT_SIGMA`) for landmarks at joints and wide (`SURFACE_SIGMA`) for those on the surface.
  Directions that poses absorb show no residual, so nothing works against the pull.
- *Symmetry.* Left and right share one offset, mirrored; those of the middle have no sideways part.
- *Lengths.* The part of a limb joint's offset along its own or its parent's bone stays the default's.
- *Measured bodies stay.* Statures and bone lengths are those of the first solve.

The rounds end when no offset moves by more than `CONVERGED` or after `MAX_ROUNDS`.
"""
