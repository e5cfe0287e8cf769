"""Training: from a recipe to a record."""
