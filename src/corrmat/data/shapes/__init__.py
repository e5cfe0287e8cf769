"""The embedded data set: forty parametric families, the solids they use, and their cache."""
