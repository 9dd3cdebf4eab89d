"""Damaged files, streams and requests: no crash, no hang, nothing but our errors."""
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import lz4.frame
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.reconstruct.weights import Weights

sys.path.insert(0, str(Path(__file__).parents[1] / "fuzz"))

import corpus
import fuzz
import mutators
from targets import OTHERS, RECORDINGS, TARGETS, fuzz_one

WITH_PACKETS = [name for name, one in TARGETS.items() if one.parts is not None]
THREADS = ("http",)
"""What needs a process of its own: threads are left at its end."""


@pytest.mark.parametrize("name", RECORDINGS)
def test_whole_recordings_give_all_their_events(name, tmp_path):
    for make in (corpus.small, corpus.large):
        for data in RECORDINGS[name].whole(make):
            found = fuzz_one(name, data, tmp_path)
            assert len(found) == make((12, 16), 0).info.event_count


@pytest.mark.parametrize("name", [name for name in TARGETS if name not in THREADS])
def test_damaged_files_do_no_harm(name, tmp_path):
    if not fuzz.corpora(name):
        pytest.skip("needs an extra")
    for number in range(40):
        fuzz.check(name, 0, number, tmp_path)


@pytest.mark.filterwarnings("ignore::pdavis_cv.PdavisWarning")
@pytest.mark.parametrize("name", fuzz.LIES)
def test_a_lie_costs_what_it_may(name, tmp_path):
    if not fuzz.corpora(name):
        pytest.skip("needs an extra")
    for number in range(60):
        fuzz.check(name, 0, number, tmp_path)


@pytest.mark.parametrize(("name", "seed", "number"), [
    ("aedat4", 2611250540, 6268), ("aedat4", 2611250540, 27232),
    ("aedat4", 2611250540, 16636), ("aedat4", 2611251045, 69880),
    ("aedat4", 580001, 17512),
    ("aedat31", 2611250540, 2296),
    ("aedat31", 777001, 7452), ("aedat31", 777001, 34952), ("aedat31", 77, 80),
    ("ros1", 2611251014, 748)])
def test_mutants_that_once_lost_whole_packets_lose_none(name, seed, number, tmp_path):
    if not fuzz.corpora(name):
        pytest.skip("needs an extra")
    fuzz.check(name, seed, number, tmp_path)


@pytest.mark.parametrize("name", [*OTHERS, "aedat4"])
def test_every_mutator_makes_another_file(name):
    rng = np.random.default_rng(0)
    for whole in fuzz.corpora(name):
        for change in TARGETS[name].grammar:
            made = set()
            for _ in range(20):
                try:
                    made.add(change(whole, rng))
                except mutators.BROKEN:     # not of this kind of file
                    continue
            assert not made or made - {whole}, change


@pytest.mark.parametrize("name", WITH_PACKETS)
@pytest.mark.parametrize("kind", ["longer", "shorter", "swallows", "hides",
                                  "headless"])
def test_packets_beside_a_damaged_one_are_delivered(name, kind, tmp_path):
    from targets import whole_parts
    size_at, head = {"aedat4": (4, 24), "aedat31": (20, 28)}[name]
    done = 0
    for data, packets in whole_parts(name):
        for i, (start, stop, _) in enumerate(packets[:-1]):
            packet = bytearray(data[start:stop])
            following = packets[i + 1][1] - stop
            if kind == "longer":
                packet += bytes(100_000)
            elif kind == "shorter":
                del packet[-5:]
            elif kind == "headless":
                del packet[:4]
            elif kind == "hides":    # it seems to end where the next one does
                if len(packet) < head + following:
                    continue
                del packet[-following:]
            else:
                told, = struct.unpack_from("<i", packet, size_at)
                struct.pack_into("<ii" if name == "aedat31" else "<i", packet, size_at,
                                 *(told + 2,) * (1 + (name == "aedat31")))
            found = fuzz_one(name, data[:start] + packet + data[stop:], tmp_path)
            for j, (*_, places) in enumerate(packets):
                if j != i:
                    assert np.isin(places, found).all(), (i, j)
            done += 1
    assert done > 2


@pytest.mark.parametrize("shift", [1, 30])
def test_packets_between_a_cut_and_as_long_an_insertion_are_delivered(shift, tmp_path):
    # The index is where it should be, and adds up to the file.
    from targets import whole_parts
    for data, packets in whole_parts("aedat4"):
        (_, cut, _), *between, (insertion, *_) = packets
        broken = data[:cut - shift] + data[cut:insertion] + bytes(shift)
        broken += data[insertion:]
        found = fuzz_one("aedat4", broken, tmp_path)
        for *_, places in between:
            assert np.isin(places, found).all()


def test_a_flipped_byte_in_a_packet_costs_that_packet(tmp_path):
    rng = np.random.default_rng(0)
    from targets import whole_parts
    for data, packets in whole_parts("aedat4"):
        for _ in range(20):
            i = int(rng.integers(len(packets)))
            at = int(rng.integers(*packets[i][:2]))
            broken = bytearray(data)
            broken[at] ^= 1 << int(rng.integers(8))
            found = fuzz_one("aedat4", bytes(broken), tmp_path)
            for j, (*_, places) in enumerate(packets):
                assert j == i or np.isin(places, found).all()


def bomb(path, name, content):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)


def test_weights_that_unpack_to_too_much_are_refused(tmp_path):
    bomb(tmp_path / "x.npz", "head.npy", bytes(40 << 20))
    with pytest.raises(pdavis_cv.errors.WeightsError, match="at most 16777216 are"):
        Weights.load(tmp_path / "x.npz")


@pytest.mark.parametrize("kind", [pdavis_cv.Calibration, Weights])
def test_arrays_larger_than_their_archive_are_refused(kind, tmp_path):
    path = tmp_path / "x.npz"
    header = (b"\x93NUMPY\x01\x00\x46\x00{'descr': '<f4', 'fortran_order': False, "
              b"'shape': (1099511627776,)}")
    bomb(path, "head.npy", header.ljust(79) + b"\n")
    with pytest.raises(pdavis_cv.PdavisError, match="an array of shape"):
        kind.load(path)


def test_a_stream_whose_packet_does_not_unpack_goes_on(tmp_path):
    data = corpus.dv(corpus.small)[0]
    head, packets, _ = mutators._taken_apart(data, 0)
    whole = fuzz_one("dv", data, tmp_path)
    first = next(i for i, (stream, _) in enumerate(packets) if stream == 0)
    packets[first] = 0, packets[first][1][:-9]
    found = fuzz_one("dv", mutators._together(head, packets, b""), tmp_path)
    assert 0 < len(found) < len(whole)


def test_a_stream_whose_packet_unpacks_to_too_much_ends(tmp_path):
    data = corpus.dv(corpus.small)[0]
    head, packets, _ = mutators._taken_apart(data, 0)
    bomb = struct.pack("<I", (1 << 26) - 4) + bytes((1 << 26) - 4)
    packets[0] = 0, lz4.frame.compress(bomb)
    with pytest.raises(pdavis_cv.DeviceError, match="more than the limit ratio"):
        TARGETS["dv"].read(mutators._together(head, packets, b""), tmp_path)


def test_a_stream_with_a_time_years_away_is_not_searched_through(tmp_path):
    data = corpus.dv(corpus.small)[0]
    head, packets, _ = mutators._taken_apart(data, 0)
    i = max(i for i, (stream, _) in enumerate(packets) if stream == 0)
    inner = bytearray(lz4.frame.decompress(packets[i][1]))
    inner[-10] = 7      # of the last event's time
    packets[i] = 0, lz4.frame.compress(bytes(inner), store_size=False)
    assert len(fuzz_one("dv", mutators._together(head, packets, b""), tmp_path)) > 20


def test_the_runner_counts_its_runs():
    # A process of its own: it forks, and has no threads that would not survive that.
    run = subprocess.run(
        [sys.executable, "-P", str(Path(fuzz.__file__)),
         "--seconds", "0.5", "--seed", "1", "--target", "load"],
        capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "load" in run.stdout


def test_the_runner_tells_what_dies_hangs_or_loses(monkeypatch, tmp_path, capsys):
    import os
    import signal
    import time

    def broken(name, seed, number, folder):
        if number == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 1:
            end = time.process_time() + 5
            while time.process_time() < end:
                pass
        if number == 2:
            raise fuzz.LostError("3 events of packets that are whole")

    def counted(name, seed, first, *arguments):
        if first == 3:
            raise KeyboardInterrupt
        return in_a_child(name, seed, first, *arguments)

    in_a_child = fuzz.in_a_child
    monkeypatch.setattr(fuzz, "in_a_child", counted)
    monkeypatch.setattr(fuzz, "check", broken)
    monkeypatch.setattr(fuzz, "LONGEST_S", 0.05)
    assert fuzz.main(["--target", "load", "--seconds", "600", "--keep",
                      str(tmp_path)]) == 1
    said = capsys.readouterr().out
    for word in ("SIGKILL", "SIGPROF", "LostError", ": 3 files, load 3;"):
        assert word in said
    assert len(list(tmp_path.iterdir())) == 3
