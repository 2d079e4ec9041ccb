"""The method: one file a step of sections 3, 4 and 6.1 of the paper."""
