"""Recover scene parameters from pictures: problem, loop, run folder, report."""

from __future__ import annotations

from pathreplay.inverse.config import Config, load_config, make_config
from pathreplay.inverse.job import RunResult, iterate, optimize
from pathreplay.inverse.session import Session, State

__all__ = ["Config", "RunResult", "Session", "State", "iterate", "load_config", "make_config", "optimize"]
