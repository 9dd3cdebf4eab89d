"""Process many recordings with any `concurrent.futures.Executor`.

A *job* is one recording, one set of options and one *work* (what is done with it).
`jobs` defines jobs and names them by their content; `works` holds the built-in works;
`worker` does one job, in whatever process calls it; `results` stores what it returns;
`pools` makes executors; `engine` distributes the jobs; `table` lists the results.
"""
from pdavis_cv._door import attached

__getattr__, __dir__, __all__ = attached(__name__, __file__)
