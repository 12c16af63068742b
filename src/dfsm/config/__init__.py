"""YAML files to settings."""
