"""Models against recorded runs."""
