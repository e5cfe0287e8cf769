"""One paper's network a file, and the blocks that they share."""
