"""pdavis: fuse frames and events of a polarization event camera."""
from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Sequence

from pdavis_cv import __version__
from pdavis_cv.registry import nearest

from ._common import OneLineParser, UsageError, command

# Description of each subcommand, which is pdavis_cv.tools.<name>.main(argv).
COMMANDS = {
    "info": "show what a recording contains",
    "view": "show a recording or a live source in a browser, and stream it as MJPEG",
    "stream": "send a recording or a live source to DV and dv-processing",
    "webcam": "show a recording or a live source as a webcam",
    "devices": "list connected cameras, or record the raw data of one",
    "export": "fuse a recording into a video, pictures or arrays",
    "batch": "process many recordings, on all cores or a cluster",
    "convert": "write a recording in another format",
    "calibrate": "measure a camera into its calibration file",
    "score": "find the best method for a recording, by predicting left-out frames",
    "simulate": "simulate a recording with known ground truth",
    "fan": "make a video of a rotating wheel of polarizers, and measure its angles",
    "tendon": "measure a loaded sample: traces, spectra, lock-in maps, a report",
    "weights": "convert the checkpoint of a published network, or show a weights file",
    "demo": "make pictures of the included recordings",
}

# For bash, and zsh by way of its bashcompinit.  Options are those that --help prints.
COMPLETION = """\
_pdavis() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" words=
    if [ "$COMP_CWORD" = 1 ]; then words="{commands}"
    elif [ "${{word#-}}" != "$word" ]; then
        words=$(pdavis "${{COMP_WORDS[1]}}" --help | grep -o -e '--[a-z][a-z0-9-]*' |
            sort -u)
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
[ -z "$ZSH_VERSION" ] || {{ autoload -U +X bashcompinit && bashcompinit; }}
complete -o default -F _pdavis pdavis
"""


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand; return 0, or 2 after a mistake of the user."""
    width = max(map(len, COMMANDS))
    parser = OneLineParser(
        prog="pdavis", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join([
            "commands:", *(f"  {name:<{width}}  {what}"
                           for name, what in COMMANDS.items()),
            "", "example:", "  pdavis export recording.aedat4 -o fused.webm --fps 200",
            "", "pdavis COMMAND --help shows its options."]))
    parser.add_argument("command", metavar="COMMAND", nargs="?", help="see below")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    parser.add_argument(
        "--version", action="version", version=f"pdavis_cv {__version__}")
    parser.add_argument("--completion", action="store_true", help="print the "
                        'completion of a shell: eval "$(pdavis --completion)"')
    args = parser.parse_args(argv)
    if args.completion:
        print(COMPLETION.format(commands=" ".join(COMMANDS)), end="")
        return 0
    if args.command is None:
        parser.print_help()
        return 0
    if args.command not in COMMANDS:
        near = nearest(args.command, COMMANDS)
        raise UsageError(
            f"no command {args.command!r}; "
            + (f"did you mean {near}? " if near else "")
            + f"there are {', '.join(COMMANDS)}, see pdavis --help")
    # What its decoders say of a damaged file would stand between our lines.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    module = importlib.import_module(f"pdavis_cv.tools.{args.command}")
    result: int = module.main(args.arguments)
    return result


if __name__ == "__main__":
    raise SystemExit(main())
