"""Run random cases for a time, and print every crash, hang, unannounced exception and excess of memory.

python -m tests.fuzz SECONDS SEED [--cases N] [--only KIND [NUMBER...]]
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fuzz import KINDS  # noqa: E402
from fuzz.sandbox import Sandbox  # noqa: E402


def main() -> int:
    """Return 1 if there was a finding."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.partition("\n")[0])
    parser.add_argument("seconds", type=float, help="stop after this time")
    parser.add_argument("seed", type=int, help="the same seed gives the same cases")
    parser.add_argument("--cases", type=int, default=10**9, metavar="N", help="stop after this number of cases")
    parser.add_argument("--only", nargs="+", metavar=("KIND", "NUMBER"), help=f"one of {', '.join(KINDS)}")
    args = parser.parse_args()
    kinds = args.only[:1] if args.only else list(KINDS)
    numbers = [int(word) for word in args.only[1:]] if args.only else []
    begin, done, findings = time.monotonic(), Counter(), 0
    with Sandbox(args.seed) as sandbox:
        for place in range(len(numbers) or args.cases):
            if time.monotonic() - begin > args.seconds:
                break
            kind = kinds[place % len(kinds)]
            number = numbers[place] if numbers else place // len(kinds)
            finding = sandbox.run(kind, number)
            done[kind] += 1
            if finding:
                findings += 1
                print(f"FINDING: python -m tests.fuzz 60 {args.seed} --only {kind} {number}\n{finding}\n", flush=True)
    counts = ", ".join(f"{kind} {count:,}" for kind, count in done.items())
    print(f"{done.total():,} cases in {time.monotonic() - begin:.0f} s, {findings} findings ({counts})")
    for kind, (more, seconds) in sandbox.worst.items():
        print(f"{kind}: at most {more >> 20} MiB and {seconds:.2f} s of the processor for a case")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
