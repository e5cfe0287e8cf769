"""Records of experiments, and their tables, figures and pages."""
