"""Run ``python -m lab.paper``."""
from importlib import import_module

from pdavis_cv.tools._common import command

if __name__ == "__main__":
    raise SystemExit(command(lambda a: import_module("lab.paper.command").main(a))())
