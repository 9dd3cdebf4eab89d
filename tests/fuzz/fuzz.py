"""Read damaged recordings until the time is over; say what broke.

python tests/fuzz/fuzz.py --seconds 60 [--seed N] [--target aedat4]
"""
import argparse
import os
import re
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from targets import TARGETS, fuzz_one  # noqa: E402

LONGEST_S = 10.0    # of CPU time
MOST_MB = 500


def mutate(data, rng):
    """Return a damaged copy: a flipped bit or byte, a cut, a hole, a repeat, noise."""
    data = bytearray(data)
    kind = int(rng.integers(8))
    at = int(rng.integers(len(data)))
    if kind <= 2:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 3:
        data[at] = int(rng.integers(256))
    elif kind == 4:
        del data[at:]
    elif kind == 5:
        del data[at:at + int(rng.integers(1, 64))]
    elif kind == 6:
        data[at:at] = data[at:at + int(rng.integers(1, 4096))]
    else:
        n = int(rng.integers(1, 16))
        data[at:at + n] = rng.bytes(n)
    return bytes(data)


def main(argv=None):
    """Return 0 if nothing broke."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--target", choices=TARGETS, default=None)
    parser.add_argument("--keep", type=Path, default=Path("."),
                        help="folder for files that broke something")
    parser.add_argument("--most-mb", type=float, default=MOST_MB,
                        help="memory; sanitizers keep what is freed")
    args = parser.parse_args(argv)
    seed = int.from_bytes(os.urandom(4)) if args.seed is None else args.seed
    names = [args.target] if args.target else list(TARGETS)
    corpora = {name: corpus for name in names if (corpus := TARGETS[name]())}
    names = list(corpora)  # without h5py there is nothing to damage
    end = time.monotonic() + args.seconds
    runs = {name: 0 for name in names}
    slowest = 0.0
    for number in range(1 << 60):
        if time.monotonic() >= end:
            break
        name = names[number % len(names)]
        rng = np.random.default_rng([seed, number])
        data = corpora[name][int(rng.integers(len(corpora[name])))]
        for _ in range(int(rng.integers(1, 4))):
            data = mutate(data, rng) or b"\0"
        begun = time.process_time()     # others may use this machine
        try:
            fuzz_one(data)
        except BaseException as error:
            path = args.keep / f"fuzz-{name}-{seed}-{number}.bin"
            path.write_bytes(data)
            print(f"{name}: seed {seed}, run {number}: {error!r}; kept as {path}")
            raise
        slowest = max(slowest, time.process_time() - begun)
        runs[name] += 1
        assert slowest < LONGEST_S, f"{name}: seed {seed}, run {number}: {slowest} s"
    peak = peak_mb()
    print(f"seed {seed}: " + ", ".join(f"{n} {c}" for n, c in runs.items())
          + f" runs, slowest {slowest:.2f} CPU s, peak {peak:.0f} MB")
    assert peak < args.most_mb
    return 0


def peak_mb():
    """Return this process's peak memory; ru_maxrss would count its parent's too."""
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+) kB", status)[1]) / 1024


if __name__ == "__main__":
    raise SystemExit(main())
