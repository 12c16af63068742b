"""A platform-like motion whose derivatives are known, sampled and rounded as files do it."""

from __future__ import annotations

import numpy as np

TIME = np.arange(4001) * 0.05
W1, W2 = 2 * np.pi / 30, 2 * np.pi / 7.3


def motion(t):
    """Platform-like: a slow mode and a wave; value, first and second derivative."""
    a, b = W1 * t, W2 * t + 1
    return (
        np.sin(a) + 0.2 * np.sin(b),
        W1 * np.cos(a) + 0.2 * W2 * np.cos(b),
        -(W1**2) * np.sin(a) - 0.2 * W2**2 * np.sin(b),
    )


def error(got, true):
    return np.std(got - true) / np.std(true)


def quantised(values, step):
    return np.round(values / step) * step
