"""Which structure."""
