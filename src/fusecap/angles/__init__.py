"""Joint angles as biomechanists publish them, with error bars; see docs/angles.md."""
