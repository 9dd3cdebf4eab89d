"""The names of this room, and the module of each: the only list of them."""
from .engine import plan as plan, run as run
from .jobs import Job as Job, Work as Work
from .table import Table as Table, status as status
from .works import (
    WORKS as WORKS,
    Calibrate as Calibrate,
    Export as Export,
    Score as Score,
    Trace as Trace,
    both_halves as both_halves,
    predicted as predicted,
)
