"""Collocation schemes and meshes."""
