"""Motion onto somebody else's rigged character."""
