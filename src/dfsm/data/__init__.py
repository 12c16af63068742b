"""Runs: read, described, completed, differentiated."""
