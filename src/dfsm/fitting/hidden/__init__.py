"""Models with hidden states, fitted on what they give: rollouts against records."""
