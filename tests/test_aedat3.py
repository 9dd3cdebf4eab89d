"""AEDAT-3.1 import; files are made byte by byte."""
import numpy as np
import pytest
from aedat31_bytes import aedat31_file
from test_aedat4 import assert_same, joined, read
from test_aedat4_writer import small

from pdavis_cv import DamagedFileWarning, RecordingError, open_recording


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "x.aedat"
    path.write_bytes(aedat31_file(small()))
    return path


def test_import_keeps_everything_upright(path):
    wanted = joined(small().packets())
    with open_recording(path) as recording:
        got = joined(recording.packets())
        assert recording.info.format == "AEDAT-3.1"
        assert recording.info.sensor_size == (12, 16)
        assert not recording.problems
    edges = wanted[3][np.isin(wanted[3]["type"], (1, 2, 3))]
    assert_same(got, (*wanted[:3], edges))


def test_a_damaged_packet_costs_itself_only(path):
    data = bytearray(path.read_bytes())
    wanted = joined(small().packets())[0]
    at = len(data) // 2
    # The next packet header after the middle: event size 8, time offset 4.
    at = data.index(b"\x08\0\0\0\x04\0\0\0", at) - 4
    data[at:at + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(data)
    with pytest.warns(DamagedFileWarning, match=f"byte {at}: no whole packet"):
        (events, *_), _ = read(path)
    assert 4600 < len(events) < 5000
    assert np.isin(events, wanted).all()


def test_a_file_without_the_header_s_end_is_refused(tmp_path):
    (tmp_path / "x").write_bytes(b"#!AER-DAT3.1\r\n" + bytes(100))
    with pytest.raises(RecordingError, match="no #!END-HEADER"):
        open_recording(tmp_path / "x")
