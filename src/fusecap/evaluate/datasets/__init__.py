"""Public data sets in our conventions, one format per file; docs/datasets.md says what goes where.

Each loader gives a `Recording`: what was measured (rig, keypoints, IMUs) and what is true.
"""
