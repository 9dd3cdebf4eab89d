"""Process many recordings, each with every combination of settings.

Jobs that are done are not repeated, so an interrupted run continues when it is called
again.  OUT receives a folder and a .json file for each job, summary.csv, and the web
page index.html.  A recording that fails becomes a row with its error.  "pdavis batch
status OUT" counts the jobs that have ended so far.
"""
from __future__ import annotations

import argparse
import importlib
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pdavis_cv import FusionOptions, batch
from pdavis_cv.batch.pools import EXECUTORS
from pdavis_cv.recording.options import SourceOptions

from ._common import Parser, UsageError, add_json_option, command, for_people, tell
from ._options import add_source_options, option_value, source_given
from ._progress import ALWAYS
from ._values import positive, within

_MOST_WORKERS = 100_000


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis batch``; return 1 if a job failed."""
    args = _parser().parse_args(argv)
    if args.files[0] == "status" and len(args.files) == 2 and args.out is None:
        return _status(args, args.files[1])
    if args.out is None:
        raise UsageError("the following arguments are required: -o/--out")
    work = _work(args.work, args.work_settings)
    options = _options(args.settings)
    if args.dry_run:
        return _dry_run(args, work, options)
    with for_people(args):
        table = batch.run(
            args.files, options, args.out, work=work, executor=args.executor,
            workers=args.jobs, retries=args.retries, timeout_s=args.timeout,
            progress=ALWAYS.get() or None, stated=SourceOptions(**source_given(args)))
    failed = table.failed
    lines = [f"{row['recording']}: {row['error']}" for row in failed[:20]]
    if len(failed) > 20:
        lines.append(f"... and {len(failed) - 20} more")
    lines.append(f"wrote {args.out}/summary.csv and index.html: {len(table)} jobs, "
                 f"{len(failed)} failed")
    tell(args, lines, out=args.out, jobs=len(table),
         failed=[{name: row[name] for name in ("recording", "error")}
                 for row in failed])
    return 1 if failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "batch", __doc__ or "",
        "pdavis batch *.aedat4 -o out --set method=cf,kalman --set fps=100 "
        "--work traces --jobs 4")
    add = parser.add_argument
    add("files", nargs="+", metavar="FILE", help="recordings; or: status OUT")
    add("-o", "--out", metavar="OUT", help="folder for results, or s3://...")
    add("--set", action="append", default=[], metavar="NAME=VALUE,...", dest="settings",
        type=_setting, help="an option of fuse or a parameter of the method; several "
        "values are combined with those of all other settings; numbers of one value "
        "are separated by slashes: thresholds=0.29/0.32")
    add("--work", default="export", metavar="WORK", help=f"{', '.join(batch.WORKS)}, "
        "or MODULE:FUNCTION of your own; default export")
    add("--with", action="append", default=[], metavar="NAME=VALUE",
        dest="work_settings", type=_setting, help="parameters of the work: export has "
        "suffix (.npz, .h5, .ome.tif), quantities, start_s, stop_s; traces regions, "
        "start_s, stop_s; score seconds; calibrate nominal")
    add("--jobs", type=within(1, _MOST_WORKERS), metavar="N",
        help="number of jobs at a time; default: one per core")
    add("--executor", default="process", metavar="WHERE",
        help=f"{EXECUTORS}, which makes a concurrent.futures.Executor; default process")
    add("--retries", type=within(0, 100), default=1, metavar="N",
        help="number of further attempts at a job that failed; default 1")
    add("--timeout", type=positive, metavar="S",
        help="time limit of each job, seconds; of executor process only")
    add("--dry-run", action="store_true", help="only print what would be done")
    add_json_option(parser)
    add_source_options(parser)
    return parser


def _setting(text: str) -> tuple[str, list[str]]:
    name, equals, values = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"NAME=VALUE is needed, got {text!r}")
    return name, values.split(",")


def _options(settings: Sequence[tuple[str, list[str]]]) -> list[FusionOptions]:
    """Return the product of all values of all settings."""
    each = [[option_value(name, value) for value in values]
            for name, values in settings]
    return [FusionOptions().replace(**dict(chosen))
            for chosen in itertools.product(*each)]


def _work(name: str, settings: Sequence[tuple[str, list[str]]]) -> batch.Work:
    module, colon, function = name.partition(":")
    if colon:
        try:
            work: Any = getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise UsageError(f"--work {name}: {error}") from None
    elif name in batch.WORKS:
        work = batch.WORKS[name]
    else:
        raise UsageError(
            f"--work must be one of {', '.join(batch.WORKS)} or "
            f"MODULE:FUNCTION, got {name!r}")
    changes = dict(_work_values(settings))
    if not changes:
        return work  # type: ignore[no-any-return]
    known = list(getattr(work, "__dataclass_fields__", ()))
    for one in changes:
        if one not in known:
            raise UsageError(
                f"--with {one}: {name} has {', '.join(known) or 'nothing to set'}")
    changed: batch.Work = replace(work, **changes)
    return changed


def _work_values(
    settings: Sequence[tuple[str, list[str]]]
) -> Iterator[tuple[str, Any]]:
    for name, values in settings:
        if name in ("quantities", "regions"):
            yield name, tuple(value.replace("/", ",") for value in values)
        elif name == "nominal":
            yield name, tuple(map(positive, values))
        elif len(values) > 1:
            raise UsageError(f"--with {name} takes one value, got {','.join(values)}")
        else:
            yield option_value(name, values[0])


def _dry_run(
    args: argparse.Namespace, work: batch.Work, options: Sequence[FusionOptions]
) -> int:
    jobs: list[dict[str, Any]] = []
    with for_people(args):
        for job, is_done in batch.plan(
                args.files, options, args.out, work=work,
                stated=SourceOptions(**source_given(args))):
            print(f"{'done ' if is_done else 'to do'}  {job.name}  {job.source}")
            jobs.append({"name": job.name, "recording": job.source, "done": is_done})
    tell(args, [f"{len(jobs)} jobs, {sum(job['done'] for job in jobs)} of them done"],
         jobs=jobs)
    return 0


def _status(args: argparse.Namespace, out: str) -> int:
    table = batch.status(out)
    errors = Counter(row["error"] for row in table.failed)
    done, failed = len(table) - errors.total(), errors.total()
    tell(args, [f"{Path(out)}: {done} done, {failed} failed",
                *(f"{count} x {error}" for error, count in errors.most_common())],
         done=done, failed=failed, errors=errors)
    return 0
