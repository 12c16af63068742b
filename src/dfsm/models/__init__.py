"""What a surrogate is, and how it is evaluated."""
