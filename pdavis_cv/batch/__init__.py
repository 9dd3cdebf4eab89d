"""Many recordings, any `concurrent.futures.Executor`.  For laboratories with hundreds.

`jobs` say what is to be done and name it by its content, `works` do it, `worker` does
one of them in whatever process it finds itself, `results` keep what came out, `pools`
are what runs them, `engine` hands them out, `table` shows them.
"""
from pdavis_cv.batch.engine import plan, run
from pdavis_cv.batch.jobs import Job, Work
from pdavis_cv.batch.status import Status, status
from pdavis_cv.batch.table import Table
from pdavis_cv.batch.works import WORKS, Calibrate, Export, Score, Trace, predicted

__all__ = ["WORKS", "Calibrate", "Export", "Job", "Score", "Status", "Table", "Trace",
           "Work", "plan", "predicted", "run", "status"]
