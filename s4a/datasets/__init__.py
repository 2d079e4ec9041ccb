"""Collections with a known truth."""
