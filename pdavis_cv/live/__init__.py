"""Sources that run by themselves, and the session that fuses what they send.

`open_source` opens a recording or the address of a device: ``usb:``, ``dv+tcp:``,
``replay:`` or ``simulate:``.  `Session` reads it in a thread of its own, so that
reading never waits for fusing, and gives images as they can be made.
"""
from pdavis_cv.live.address import SOURCES, is_address, open_source
from pdavis_cv.live.base import Address, LiveSource
from pdavis_cv.live.dv_server import LOOPBACK, DvServer
from pdavis_cv.live.recorder import recorded
from pdavis_cv.live.session import Session
from pdavis_cv.live.statistics import SessionStats
from pdavis_cv.live.tls import server_context

__all__ = ["LOOPBACK", "SOURCES", "Address", "DvServer", "LiveSource", "Session",
           "SessionStats", "is_address", "open_source", "recorded", "server_context"]
