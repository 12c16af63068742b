"""A model, refined on rollouts."""
