"""Models how a step scales to many devices, and simulates the schedule with stragglers and failures.

    python -m benchmarks.schedule [--measure]

The command prints the modelled seconds of a step for 1 to 1000 devices, 10^6 to 10^9 parameters, and three ways to sum
gradients. Then it simulates the first way with the scheduler of jobs (`pathreplay.distributed.scheduler`), for devices
of different speeds, shards that get stuck, and devices that are lost. `--measure` first measures the costs on this
machine. Otherwise the constants below are used, which were measured in the same way. The command takes a minute.
"""

from __future__ import annotations

import heapq
import time
from dataclasses import dataclass, replace
from statistics import mean
from typing import Annotated

import numpy as np
import typer

from pathreplay.distributed.scheduler import Scheduler, Step
from pathreplay.inverse.objective.evaluate import Shard

DEVICES, PARAMETERS = (1, 10, 100, 1000), (10**6, 10**7, 10**8, 10**9)
BYTES = 4
"""Bytes of a value, and of an entry of a gradient."""
STEPS, COUNTED = 12, 8
"""Steps of a simulation, and number of last steps that count. In the first steps, no durations are known."""


@dataclass(frozen=True)
class Costs:
    """Costs in seconds. Compute and network are assumptions set by options; the others are measured (`--measure`)."""

    shard: float = 1.0
    """Compute of a shard."""
    network: float = 1.25e9
    """Bytes per second and direction of every machine: 10 gigabit Ethernet."""
    add: float = 4.2e-10
    """Adding an entry of a gradient to the sum."""
    step: float = 9.1e-10
    """Optimizer step per parameter."""
    latency: float = 7.5e-4
    """Round trip of a request for a shard."""

    def send(self, parameters: float) -> float:
        """Seconds to send values or a gradient between two machines."""
        return BYTES * parameters / self.network


def built(costs: Costs, shards: int, devices: int, parameters: float) -> float:
    """Seconds of a step of a job: values are broadcast along a tree, and one process sums all gradients and steps.

    Gradients are fetched while other shards are computed. The time of both is therefore the maximum of two sums: all
    computing plus one fetch, or the computing of one shard plus all fetches.
    """
    out = np.ceil(np.log2(devices + 1)) * costs.send(parameters) if devices > 1 else 0.0
    one_back = (costs.send(parameters) if devices > 1 else 0.0) + costs.add * parameters
    compute = np.ceil(shards / devices) * (costs.shard + costs.latency)
    return float(out + max(compute + one_back, costs.shard + shards * one_back) + costs.step * parameters)


def summed(costs: Costs, shards: int, devices: int, parameters: float) -> float:
    """Seconds with an all-reduce: each device sums its fixed shards, a ring reduces the sums, and all devices step."""
    compute = np.ceil(shards / devices) * (costs.shard + costs.latency + costs.add * parameters)
    ring = 2 * (devices - 1) / devices * costs.send(parameters)
    return float(compute + ring + costs.step * parameters)


def sharded(costs: Costs, shards: int, devices: int, parameters: float) -> float:
    """Seconds as in `summed` with a sharded optimizer: each device steps its part of the parameters."""
    return summed(costs, shards, devices, parameters) - costs.step * parameters * (1 - 1 / devices)


@dataclass(frozen=True)
class Trouble:
    """Disturbances of devices."""

    spread: float = 0.0
    """Standard deviation of the logarithm of their speeds."""
    stuck: float = 0.0
    """Fraction of shards that take ten times as long."""
    lost_after: float = np.inf
    """Mean seconds of work until a device is lost."""
    back_after: float = 30.0
    """Seconds until a replacement is ready, with scene and kernels loaded."""


def simulated(costs: Costs, shards: int, devices: int, parameters: float, trouble: Trouble, seed: int = 0) -> float:
    """Mean seconds of a step in an event-based simulation of the scheduler of jobs."""
    random = np.random.default_rng(seed)
    speeds = np.exp(trouble.spread * random.standard_normal(devices))
    speeds *= devices / speeds.sum()  # the same total speed as without spread
    scheduler, work = Scheduler(), [Shard((view,), 1, (view,)) for view in range(shards)]
    simulation = _Devices(costs, parameters, trouble, random, speeds, free=[0.0] * devices)
    return mean([simulation.step(Step(scheduler, work)) for _ in range(STEPS)][-COUNTED:])


@dataclass
class _Devices:
    """State of the devices between steps. A device may still compute a shard that another device has finished."""

    costs: Costs
    parameters: float
    trouble: Trouble
    random: np.random.Generator
    speeds: np.ndarray
    free: list[float]
    """Time at which each device becomes idle."""
    now: float = 0.0

    def step(self, step: Step) -> float:
        """Simulate a step; returns its seconds."""
        begin, costs, n = self.now, self.costs, len(self.speeds)
        self.now += float(np.ceil(np.log2(n + 1))) * costs.send(self.parameters) if n > 1 else 0.0
        one_back = (costs.send(self.parameters) if n > 1 else 0.0) + costs.add * self.parameters
        idle = [k for k in range(n) if self.free[k] <= self.now]
        # Time, device, shards (none: the device becomes idle), seconds, and whether the device survives.
        events: list[tuple[float, int, list[int], float, bool]]
        events = [(self.free[k], k, [], 0.0, True) for k in range(n) if self.free[k] > self.now]
        heapq.heapify(events)
        fetched, asleep = self.now, np.inf  # time at which all received gradients are added
        while len(step.done) < len(step.kinds):
            waiting = list(idle)
            for k in step.in_turn(idle):
                if (index := step.next(k, self.now, idle)) is None:
                    break  # as in `RayExecutor`
                waiting.remove(k)
                indices = [index, *step.along(k, int(BYTES * self.parameters), n)]
                seconds, lives = self._seconds(k, len(indices))
                self.free[k] = self.now + seconds + (0 if lives else self.trouble.back_after)
                heapq.heappush(events, (self.now + seconds, k, indices, seconds, lives))
            late = step.patience() if waiting else None
            asleep = np.inf if late is None else max(self.now, late)
            if asleep < (events[0][0] if events else np.inf):
                self.now, idle = asleep, waiting
                continue
            self.now, k, indices, seconds, lives = heapq.heappop(events)
            idle = waiting
            if not lives:
                step.scheduler.forget(k)
                for index in indices:
                    step.lost(index, k)
                heapq.heappush(events, (self.free[k], k, [], 0.0, True))
                continue
            idle = [*waiting, k]
            for index in indices:
                if step.finished(index, k, seconds / len(indices)):
                    fetched = max(fetched, self.now) + one_back
        self.now = max(self.now, fetched) + costs.step * self.parameters
        return self.now - begin

    def _seconds(self, k: int, shards: int) -> tuple[float, bool]:
        """Seconds of a request for ``shards`` shards, and whether the device survives it."""
        times = sum(10.0 if self.random.random() < self.trouble.stuck else 1.0 for _ in range(shards))
        seconds = self.costs.latency + self.costs.shard * times / float(self.speeds[k])
        lost = (
            float(self.random.exponential(self.trouble.lost_after)) if np.isfinite(self.trouble.lost_after) else np.inf
        )
        return (lost, False) if lost < seconds else (seconds, True)


def measured(costs: Costs, size: int = 2 * 10**7) -> Costs:
    """Measure the costs on this machine in one thread; the optimizer's values are in Dr.Jit's memory."""
    from pathreplay.platform import backend

    backend.set_variant("llvm_ad_rgb")
    from pathreplay.inverse.optim.adaptive import DrJitOptimiser

    a, b = np.ones(size, np.float32), np.ones(size, np.float32)
    optimiser = DrJitOptimiser({"a": a})
    add = min(_timed(lambda: np.add(a, b)) for _ in range(5)) / size
    step = min(_timed(lambda: optimiser.step({"a": a}, {"a": b}, {"a": 0.01})) for _ in range(3)) / size
    return replace(costs, add=add, step=step)


def measured_ray(costs: Costs, size: int = 10**7) -> Costs:
    """Measure the latency of a call of a local actor; also prints the bandwidth of gradients."""
    from pathreplay.distributed.cluster import connected
    from pathreplay.inverse.config.executor_options import RayOptions

    class Echo:
        def gradient(self, size: int) -> np.ndarray:
            return np.ones(size, np.float32)

    with connected(RayOptions(), 2) as cluster:
        ray = cluster.ray
        actor = ray.remote(Echo).remote()
        ray.get(actor.gradient.remote(1))
        latency = min(_timed(lambda: ray.get(actor.gradient.remote(1))) for _ in range(50))
        back = min(_timed(lambda: ray.get(actor.gradient.remote(size))) for _ in range(5))
    print(
        f"Ray here: {latency * 1e3:.2g} ms for a call, {BYTES * size / (back - latency) / 1e9:.2g} GB/s for gradients"
    )
    return replace(costs, latency=latency)


def _timed(work: object) -> float:
    begin = time.perf_counter()
    work()  # type: ignore[operator]
    return time.perf_counter() - begin


TROUBLES = {
    "none": Trouble(),
    "speeds differ by a fourth": Trouble(spread=0.25),
    "1 shard in 100 takes 10 times as long": Trouble(stuck=0.01),
    "each device is lost once an hour": Trouble(lost_after=3600.0),
    "all of it": Trouble(spread=0.25, stuck=0.01, lost_after=3600.0),
}


def main(
    measure: Annotated[bool, typer.Option("--measure", help="Measure the costs on this machine first.")] = False,
    shards: Annotated[int, typer.Option(help="Shards per step.")] = 4000,
    seconds: Annotated[float, typer.Option(help="Compute time of a shard.")] = 1.0,
    gigabits: Annotated[float, typer.Option(help="Network bandwidth of each machine in Gbit/s.")] = 10.0,
) -> None:
    """Print the tables."""
    costs = Costs(shard=seconds, network=gigabits * 1e9 / 8)
    if measure:
        costs = measured_ray(measured(costs))
    print(f"{shards} shards of {seconds:g} s, {gigabits:g} gigabit a second, {costs.add:.1e} s to add an entry, "
          f"{costs.step:.1e} s to step a parameter\n")  # fmt: skip
    ways = {"as built": built, "sums in a ring": summed, "and a sharded optimiser": sharded}
    print("| parameters | " + " | ".join(f"{n} {'device' if n == 1 else 'devices'}" for n in DEVICES) + " | way |")
    print("| ---: |" + " ---: |" * len(DEVICES) + " --- |")
    for parameters in PARAMETERS:
        for name, way in ways.items():
            cells = [way(costs, shards, n, parameters) for n in DEVICES]
            row = " | ".join(f"{s:.4g} s ({cells[0] / (n * s):.0%})" for n, s in zip(DEVICES, cells, strict=True))
            print(f"| {parameters:.0e} | {row} | {name} |")
    print("\nas built, no more than half of the devices' time is waiting up to:")
    for parameters in PARAMETERS:
        limit = max((n for n in range(2, 4001) if _efficiency(costs, shards, n, parameters) >= 0.5), default=1)
        print(f"  {parameters:.0e} parameters: {limit} devices")
    print("\nsimulated, 10^6 parameters, seconds of a step over those of the model:\n")
    print("| trouble | " + " | ".join(f"{n} devices" for n in DEVICES[1:]) + " |")
    print("| --- |" + " ---: |" * len(DEVICES[1:]))
    for name, trouble in TROUBLES.items():
        ratios = [simulated(costs, shards, n, 10**6, trouble) / built(costs, shards, n, 10**6) for n in DEVICES[1:]]
        print(f"| {name} | " + " | ".join(f"{ratio:.2f}" for ratio in ratios) + " |")


def _efficiency(costs: Costs, shards: int, devices: int, parameters: float) -> float:
    return built(costs, shards, 1, parameters) / (devices * built(costs, shards, devices, parameters))


if __name__ == "__main__":
    typer.run(main)
