"""Runs cases on a few processes at once, and says by kind what came of them."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from .case import Action, Case
from .judge import Ended, Verdict, judge
from .room import Room
from .snapshot import snapshot

TESTS = Path(__file__).resolve().parents[1]

#: Over three times what the slowest takes on two quiet cores while all of its kernels are new: 16 s.
TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Result:
    """A case, what was run, how that ended, and the verdict."""

    case: Case
    action: Action
    ended: Ended
    verdict: Verdict

    def __str__(self) -> str:
        words = (self.ended.stderr or self.ended.stdout).strip()
        last = words.splitlines()[-1][:300] if words else ""
        findings = ", ".join(self.verdict.findings) or self.verdict.outcome
        return f"{self.case}: {findings} [{self.ended.seconds:.1f} s, {self.ended.peak_mb} MB]\n      {last!r}"


class Lane:
    """One server process and the rooms in which its cases happen."""

    def __init__(self, scratch: Path, assets: Path) -> None:
        self.scratch, self.assets = scratch, assets
        scratch.mkdir(parents=True)
        # One thread for NumPy: a fork should find as few threads as possible.
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        paths = [str(TESTS), str(TESTS / "support"), environment.get("PYTHONPATH")]
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
        self._server = subprocess.Popen(
            [sys.executable, "-m", "hostile.server"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip

    def run(self, action: Action, folder: Path, timeout: float = TIMEOUT_S) -> Ended:
        """Run an action in a folder."""
        assert self._server.stdin is not None and self._server.stdout is not None
        out, err = self.scratch / "stdout", self.scratch / "stderr"
        request = asdict(action) | {"folder": str(folder), "stdout": str(out), "stderr": str(err), "timeout": timeout}
        print(json.dumps(request), file=self._server.stdin, flush=True)
        answer = self._server.stdout.readline()
        if not answer:
            raise RuntimeError("the server of hostile cases died")
        words = [path.read_bytes()[: 2**22].decode("utf-8", "backslashreplace") for path in (out, err)]
        return Ended(**json.loads(answer), stdout=words[0], stderr=words[1])

    def try_case(self, case: Case, timeout: float = TIMEOUT_S) -> Result:
        """Make a fresh room, spoil it, run what meets it, and judge."""
        ground = self.scratch / "ground"
        shutil.rmtree(ground, ignore_errors=True)
        room = Room.new(ground, self.assets)
        action = case.prepare(room)
        before = snapshot(ground)
        ended = self.run(action, room.path, timeout)
        return Result(case, action, ended, judge(case.recipe, action, ended, before, snapshot(ground)))

    def close(self) -> None:
        """End the server."""
        with self._server:  # closes its pipes
            self._server.kill()


def make_assets(scratch: Path) -> Path:
    """The files that rooms are copied from."""
    assets = scratch / "assets"
    assets.mkdir(parents=True)
    vdb = TESTS / "data" / "vdb.zip"
    lane = Lane(scratch / "first", assets)
    code = f"from pathlib import Path; from hostile.assets import make; make(Path({str(assets)!r}), Path({str(vdb)!r}))"
    ended = lane.run(Action(script=code), assets)
    lane.close()
    if ended.status != 0:
        raise RuntimeError(f"the job without anything hostile does not work: {ended}")
    return assets


def run_cases(
    cases: Iterable[Case], lanes: int = 2, told: Callable[[Result], None] = lambda result: None, limit_s: float = 3600
) -> list[Result]:
    """Try all cases, several at once; ``told`` hears of each. None is begun after ``limit_s`` seconds.

    Raises:
        TimeoutError: there was not enough time for all.
    """
    scratch, results, end = Path(tempfile.mkdtemp(prefix="hostile-")), [], time.monotonic() + limit_s
    waiting: queue.SimpleQueue[Case] = queue.SimpleQueue()
    for case in cases:
        waiting.put(case)
    failures: list[BaseException] = []

    def work(lane: Lane) -> None:
        try:
            while time.monotonic() < end and not failures:
                result = lane.try_case(waiting.get_nowait())
                results.append(result)
                told(result)
        except queue.Empty:
            pass
        except BaseException as error:
            failures.append(error)
        finally:
            lane.close()

    try:
        assets = make_assets(scratch)
        workers = [threading.Thread(target=work, args=[Lane(scratch / f"lane{i}", assets)]) for i in range(lanes)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if failures:
        raise failures[0]
    if not waiting.empty():
        raise TimeoutError(f"{waiting.qsize()} cases were not tried within {limit_s:.0f} s")
    return sorted(results, key=lambda result: result.case.number)


def table(results: list[Result]) -> str:
    """How many cases of each kind, and what came of them."""
    kinds = dict.fromkeys(result.case.recipe.kind for result in results)
    outcomes = ("finished", "finished, not liked", "refused", "ended by a signal", "findings")
    rows = [("kind", "tried", *outcomes)]
    for kind in (*kinds, "all"):
        chosen = [result for result in results if kind in (result.case.recipe.kind, "all")]
        counts = Counter("findings" if result.verdict.findings else result.verdict.outcome for result in chosen)
        rows.append((kind, str(len(chosen)), *(str(counts[outcome]) for outcome in outcomes)))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) if i == 0 else cell.rjust(width)
             for i, (cell, width) in enumerate(zip(row, widths, strict=True))) for row in rows]  # fmt: skip
    slowest, largest = max(r.ended.seconds for r in results), max(r.ended.peak_mb for r in results)
    return "\n".join([*lines, f"longest {slowest:.1f} s, largest {largest} MB"])
