"""Convert a checkpoint of FireNet, or show a file of weights."""
from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pdavis_cv._beside import write_beside
from pdavis_cv.reconstruct.checkpoint import firenet_weights
from pdavis_cv.reconstruct.weights import Weights

from ._common import OneLineParser, Parser, UsageError, add_json_option, command, tell


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Convert or show; return 0."""
    parser = Parser("weights", __doc__ or "",
                    "pdavis weights convert firenet_1000.pth.tar -o firenet.npz")
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION",
                                    parser_class=OneLineParser)
    convert = actions.add_parser(
        "convert", help="convert a checkpoint of the published FireNet, without torch "
                        "and without executing its pickle")
    convert.add_argument("checkpoint", help="a file written by torch.save")
    convert.add_argument("-o", "--out", required=True, metavar="FILE.npz",
                         help="for fuse(method='firenet', weights=...)")
    show = actions.add_parser("show", help="show the content of an npz file of weights")
    show.add_argument("file", metavar="FILE.npz")
    for action in (convert, show):
        add_json_option(action)
    args = parser.parse_args(argv)
    if args.action == "show":
        _show(args, Weights.load(args.file))
        return 0
    if Path(args.out).suffix != ".npz":
        raise UsageError(f"--out must end in .npz, got {args.out!r}")
    weights = firenet_weights(args.checkpoint)
    with write_beside(Path(args.out)) as path:
        weights.save(path)
    tell(args, [f"{args.out}: {weights.parameters} weights, {weights.digest}"],
         wrote=[args.out], **_facts(weights))
    return 0


def _show(args: argparse.Namespace, weights: Weights) -> None:
    unit = ("counts events" if weights.unit is None
            else f"log intensity in units of {weights.unit:g}")
    tell(args, [
        f"{weights.network}: {weights.parameters} weights, {weights.digest}",
        f"input: {unit}",
        *(f"{name}: {value if isinstance(value, str) else json.dumps(value)}"
          for name, value in weights.about.items())], **_facts(weights))


def _facts(weights: Weights) -> dict[str, Any]:
    return {"network": weights.network, "weights": weights.parameters,
            "digest": weights.digest, "unit": weights.unit,
            "about": dict(weights.about)}
