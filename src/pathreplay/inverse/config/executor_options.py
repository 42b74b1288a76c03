"""Executor of a job (evaluation of views in this process or by Ray actors), and the options of Ray."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pathreplay.inverse.config.tables import Count, Table, Whole

ExecutorName = Literal["local", "ray"]


class RayOptions(Table):
    """The Ray cluster and its actors, for ``executor = "ray"``. These options do not change the results."""

    address: str | None = None
    """Address of a running cluster, HOST:PORT or 'auto'; default: the variable RAY_ADDRESS, or a private cluster for
    this run."""
    actors: Count | None = None
    """Number of actors; default: as many as fit on the cluster, at most one per shard of an iteration."""
    threads: Count | None = None
    """Number of cores per actor."""
    max_restarts: Annotated[Whole, Field(ge=0, le=2**31 - 1)] = 100
    """Maximum number of restarts of a lost actor."""
    max_task_retries: Annotated[Whole, Field(ge=0, le=2**31 - 1)] = 4
    """Maximum number of retries of a shard whose actor was lost."""
