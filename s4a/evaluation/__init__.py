"""How good a correspondence is, and how the methods of the paper compare (5)."""
