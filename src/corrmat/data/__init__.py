"""Sources of shapes, and the pairs that are made of them."""
