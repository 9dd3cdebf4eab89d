"""Train a network on simulated events; needs torch (pip install torch)."""
from __future__ import annotations

import csv
import importlib.util
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv._beside import write_beside
from pdavis_cv.tools._common import (
    Parser,
    UsageError,
    add_json_option,
    checked_out,
    command,
    for_people,
    tell,
)
from pdavis_cv.tools._progress import progress, stage
from pdavis_cv.tools._values import LAST_SEED, positive, within


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Train, from the start or from a checkpoint; return 0."""
    parser = Parser(
        "train", (__doc__ or "").split(";")[0],
        "python -m lab.training joint -o mine/joint.npz --steps 20000\n"
        "  pdavis export recording.aedat4 -o out.mp4 --method joint "
        "--set weights=mine/joint.npz")
    parser.prog = "python -m lab.training"
    parser.add_argument("network", choices=("joint", "firenet"))
    parser.add_argument(
        "-o", "--out", required=True, metavar="FILE.npz",
        help="weights to write; also written are FILE.pt, from which training "
             "continues if it exists, and FILE.csv with the scores")
    parser.add_argument("--steps", type=within(1, 10**9), default=20_000,
                        help="total number of updates; the rate decreases as a cosine")
    parser.add_argument("--every", type=within(1, 10**9), default=200,
                        help="updates between checkpoints")
    parser.add_argument("--seed", type=within(0, LAST_SEED), default=0)
    parser.add_argument("--rate", type=positive, default=2e-3, help="of Adam, at most")
    parser.add_argument("--batch", type=within(1, 4096), default=8,
                        help="clips side by side")
    parser.add_argument("--side", type=within(4, 512), default=20,
                        help="macropixels (2x2 pixels) along a side of a clip")
    parser.add_argument("--half", action="store_true",
                        help="convolve in bfloat16, which some processors do faster")
    add_json_option(parser)
    args = parser.parse_args(argv)
    out = Path(args.out)
    if out.suffix != ".npz":
        raise UsageError(f"--out must end in .npz, got {args.out!r}")
    checked_out(out)
    if importlib.util.find_spec("torch") is None:
        raise UsageError("training needs torch: pip install torch")
    stage("loading torch, and its first step")
    from .trainer import Recipe, Trainer, train

    recipe = Recipe(args.network, args.seed, args.steps, args.rate, args.batch,
                    args.side, half=args.half)
    checkpoint = out.with_suffix(".pt")
    if checkpoint.exists():
        trainer = Trainer.load(checkpoint, recipe)
        with for_people(args):
            print(f"{checkpoint}: going on from step {trainer.step}")
    else:
        trainer = Trainer(recipe)

    last: dict[str, float] = {}

    def told(scores: dict[str, float]) -> None:
        last.update(scores)
        with write_beside(out) as path:
            trainer.weights(scores=scores).save(path)
        row = {"step": trainer.step, "pixel_steps": trainer.pixel_steps, **scores}
        with open(out.with_suffix(".csv"), "a", newline="") as stream:
            writer = csv.writer(stream)
            if not stream.tell():
                writer.writerow(("step", "pixel_steps", "score", "mean"))
            writer.writerows((trainer.step, trainer.pixel_steps, name, f"{value:.6g}")
                             for name, value in scores.items())
        print(" ".join(f"{name}={value:.4g}" for name, value in row.items()),
              flush=True)

    with for_people(args):
        train(trainer, checkpoint, every=args.every, told=told,
              shown=lambda steps: progress(steps, len(steps), "steps"))
    tell(args, (), wrote=[out, checkpoint, out.with_suffix(".csv")],
         step=trainer.step, pixel_steps=trainer.pixel_steps, scores=last)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
