"""Who computes shards, and where: results come back in the order of the shards, whoever was ready first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from pathreplay.inverse.evaluate import Evaluate, Evaluation, Shard
from pathreplay.inverse.values import Arrays


class Executor(Protocol):
    """Evaluates the shards of an iteration."""

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> list[Evaluation]:
        """One evaluation for each shard, in their order; the last one has learned from all of them."""


class Local:
    """In this process, one after the other; each knows what those before it have learned."""

    def __init__(self, evaluate: Evaluate) -> None:
        self.evaluate = evaluate

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> list[Evaluation]:
        """See `Executor`."""
        found: list[Evaluation] = []
        for shard in shards:
            found.append(self.evaluate(values, shard, learned))
            learned = found[-1].learned
        return found
