"""`python -m tests.hostile`: try all hostile cases of a seed, those of a kind, or one, and say what came of them."""

from __future__ import annotations

import argparse
import sys

from .battery import Result, run_cases, table
from .generate import COUNT, KINDS, make_case


def main() -> int:
    """Exit status 1 if there was a finding."""
    parser = argparse.ArgumentParser(prog="python -m tests.hostile", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=COUNT, help=f"how many cases (default: {COUNT})")
    parser.add_argument("--case", type=int, action="append", help="only this one; may be given several times")
    parser.add_argument("--kind", choices=KINDS, action="append", help="only those of this kind")
    parser.add_argument("--lanes", type=int, default=2, help="how many at once")
    parser.add_argument("--list", action="store_true", help="only say what there is")
    parser.add_argument("--verbose", action="store_true", help="tell of every case, not only of findings")
    given = parser.parse_args()
    numbers = given.case if given.case is not None else range(given.count)
    cases = [make_case(given.seed, number) for number in numbers]
    if given.kind:
        cases = [case for case in cases if case.recipe.kind in given.kind]
    if given.list:
        print(*cases, sep="\n")
        return 0

    def told(result: Result) -> None:
        if result.verdict.findings or given.verbose or given.case:
            print(result, flush=True)
        if given.case:
            print(f"--- {result.action}\n--- stdout\n{result.ended.stdout}\n--- stderr\n{result.ended.stderr}")

    results = run_cases(cases, given.lanes, told)
    print(f"\n{table(results)}")
    return int(any(result.verdict.findings for result in results))


if __name__ == "__main__":
    sys.exit(main())
