"""Who computes a job's shards: this process, or actors of Ray, and how many of what size."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pathreplay.inverse.config.tables import Count, Table, Whole

ExecutorName = Literal["local", "ray"]


class RayOptions(Table):
    """With ``executor = "ray"``: the cluster, and its actors. None of it changes what comes out."""

    address: str | None = None
    """Address of a running cluster, HOST:PORT or 'auto'; default: a cluster of this run alone."""
    actors: Count | None = None
    """Number of actors; default: as many as fit, and shards of an iteration."""
    threads: Count | None = None
    """Cores of each actor."""
    max_restarts: Annotated[Whole, Field(ge=0, le=2**31 - 1)] = 100
    """How often a lost actor is restarted."""
    max_task_retries: Annotated[Whole, Field(ge=0, le=2**31 - 1)] = 4
    """How often a shard is computed again whose actor is lost."""
