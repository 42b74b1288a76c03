"""Jobs: optimizations that a config describes, from the check of the config to the report in the run folder."""

from __future__ import annotations

from pathreplay.inverse.config.schema import Config, load_config, make_config
from pathreplay.jobs.job import RunResult, iterate, optimize
from pathreplay.jobs.photographs.from_photos import PhotoJob, from_photos
from pathreplay.jobs.session import Optimization

__all__ = [
    "Config",
    "Optimization",
    "PhotoJob",
    "RunResult",
    "from_photos",
    "iterate",
    "load_config",
    "make_config",
    "optimize",
]
