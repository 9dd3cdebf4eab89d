"""Process many recordings with any `concurrent.futures.Executor`.

A *job* is one recording, one set of options and one *work* (what is done with it).
`jobs` defines jobs and names them by their content; `works` holds the built-in works;
`worker` does one job, in whatever process calls it; `results` stores what it returns;
`pools` makes executors; `engine` distributes the jobs; `table` lists the results.
"""
from pdavis_cv.batch.engine import plan, run
from pdavis_cv.batch.jobs import Job, Work
from pdavis_cv.batch.status import Status, status
from pdavis_cv.batch.table import Table
from pdavis_cv.batch.works import (
    WORKS,
    Calibrate,
    Export,
    Score,
    Trace,
    both_halves,
    predicted,
)

__all__ = ["WORKS", "Calibrate", "Export", "Job", "Score", "Status", "Table", "Trace",
           "Work", "both_halves", "plan", "predicted", "run", "status"]
