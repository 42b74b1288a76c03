"""Recover scene parameters from pictures: problem, loop, run folder, report."""

from __future__ import annotations

from pathreplay.inverse.config import Config, load_config, make_config
from pathreplay.inverse.job import RunResult, optimize

__all__ = ["Config", "RunResult", "load_config", "make_config", "optimize"]
