"""Readers of motion-capture files: ASF/AMC, BVH, exponential maps."""
