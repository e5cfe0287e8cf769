"""Data sets of shapes, and the pairs of clouds that are drawn from them."""
