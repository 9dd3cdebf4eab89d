"""Options of commands that other machines may connect to."""
from __future__ import annotations

import argparse
import ssl

from ._common import UsageError


def add_tls_options(parser: argparse.ArgumentParser, clients: str) -> None:
    """Add the options that name certificates; `clients`: what `--authority` means."""
    parser.add_argument("--certificate", metavar="PEM",
                        help="of this side and of who signed it: encrypts with TLS")
    parser.add_argument("--key", metavar="PEM",
                        help="private key of the certificate, without a passphrase")
    parser.add_argument("--authority", metavar="PEM", help=clients)


def tls_of(args: argparse.Namespace) -> ssl.SSLContext | None:
    """Return what the options ask for, None if they name no certificate."""
    if args.certificate is None:
        for name in ("key", "authority"):
            if getattr(args, name) is not None:
                raise UsageError(f"--{name} needs --certificate")
        return None
    if args.key is None:
        raise UsageError("--certificate needs --key")
    from pdavis_cv.live.tls import server_context

    try:
        return server_context(args.certificate, args.key, args.authority)
    except ValueError as error:
        raise UsageError(str(error)) from None
