"""From runs to a model."""
