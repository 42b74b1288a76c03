"""Pixelwise losses as formulas of NumPy arrays."""

from __future__ import annotations

import numpy as np

from pathreplay.inverse.losses.pixelwise import DISPLAY_FLOOR, RELATIVE_FLOOR

# What the docstrings say, in NumPy.
FORMULAS = {
    "l1": lambda i, t: np.abs(i - t).mean(),
    "l2": lambda i, t: ((i - t) ** 2).mean(),
    "relative-l2": lambda i, t: (((i - t) / (t + RELATIVE_FLOOR)) ** 2).mean(),
    "display-l2": lambda i, t: (((i - t) * 1.055 / 2.4 * np.clip(t, DISPLAY_FLOOR, 1) ** (1 / 2.4 - 1)) ** 2).mean(),
    "relative-l1": lambda i, t: (np.abs(i - t) / (t + RELATIVE_FLOOR)).mean(),
    "smape": lambda i, t: (np.abs(i - t) / (i + t + RELATIVE_FLOOR)).mean(),
    "log": lambda i, t: ((np.log1p(i) - np.log1p(t)) ** 2).mean(),
}
