"""How many heads an hour a machine makes with 1, 2 and 4 of them at once.

    python tools/fleet/throughput.py target/release/tiface CAPTURE [--heads 4] [--jobs 1 2 4] [-- OPTIONS of tiface run]

Every head is the same capture in a run of its own. Threads are shared out as the fleet does: as many for each as there
are cores for it, at least one.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path


def reconstruct(tiface, capture, run, threads, options):
    environment = {**os.environ, "RAYON_NUM_THREADS": str(threads)}
    words = [tiface, "run", capture, "--run", run, "--device", "cpu", "--quiet", *options]
    subprocess.run([str(word) for word in words], check=True, env=environment, stdout=subprocess.DEVNULL)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0], epilog="Options of `tiface run` follow `--`.")
    parser.add_argument("tiface", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--heads", type=int, default=4)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2, 4])
    # all after `--` is for the program: argparse would take some of it for its own options
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    arguments, options = parser.parse_args(words[:end]), words[end + 1 :]
    cores = len(os.sched_getaffinity(0))
    print("| at once | threads each | heads an hour | of the first |\n|---|---|---|---|")
    first = None
    for jobs in arguments.jobs:
        threads = max(1, cores // jobs)
        with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(jobs) as pool:
            begin = time.monotonic()
            made = [
                pool.submit(
                    reconstruct, arguments.tiface, arguments.capture, Path(scratch) / str(head), threads, options
                )
                for head in range(arguments.heads)
            ]
            for head in made:
                head.result()
            rate = 3600 * arguments.heads / (time.monotonic() - begin)
        first = first or rate
        print(f"| {jobs} | {threads} | {rate:.0f} | {rate / first:.2f} |", flush=True)


if __name__ == "__main__":
    main()
