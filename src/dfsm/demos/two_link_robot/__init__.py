"""The paper's two-link robot study."""
