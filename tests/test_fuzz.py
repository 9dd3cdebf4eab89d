"""Damaged recordings: no crash, no hang, nothing but our errors."""
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))

import fuzz
from targets import TARGETS, fuzz_one, recording


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_do_no_harm(name):
    for number, data in enumerate(TARGETS[name]()):
        assert fuzz_one(data) == recording((12, 16), 0).info.event_count
        for seed in range(60):
            rng = np.random.default_rng([seed, number])
            fuzz_one(fuzz.mutate(data, rng))


def test_a_flipped_byte_in_a_packet_costs_that_packet(tmp_path):
    data = TARGETS["aedat4"]()[0]
    at = 18 + int.from_bytes(data[14:18], "little")
    whole, packets = fuzz_one(data), []
    while int.from_bytes(data[at:at + 4], "little") < 4:
        size = int.from_bytes(data[at + 4:at + 8], "little")
        packets.append((at, size))
        at += 8 + size
    rng = np.random.default_rng(0)
    for _ in range(60):
        at, size = packets[rng.integers(len(packets))]
        broken = bytearray(data)
        broken[at + int(rng.integers(8 + size))] ^= 1 << int(rng.integers(8))
        # No packet of this file holds more than 10 ms of its 3000 events in 200 ms.
        assert fuzz_one(bytes(broken)) > whole - 250


def test_the_runner_counts_its_runs():
    # A process of its own: the runner judges the peak memory of its process.
    run = subprocess.run(
        [sys.executable, "-P", str(Path(__file__).parent / "fuzz" / "fuzz.py"),
         "--seconds", "0.5", "--seed", "1", "--target", "aedat4"],
        capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "aedat4" in run.stdout
