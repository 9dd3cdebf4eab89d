"""TLS with certificates on both sides, as DV uses it."""
from __future__ import annotations

import os
import ssl
from pathlib import Path


def server_context(
    certificate: str | os.PathLike[str], key: str | os.PathLike[str],
    authority: str | os.PathLike[str] | None,
) -> ssl.SSLContext:
    """Return a server's TLS context.

    Parameters
    ----------
    certificate : path
        The server's certificate chain, PEM.
    key : path
        Its private key, PEM, without a passphrase.
    authority : path or None
        Certificate of the authority that signs the clients' certificates, PEM; None:
        clients need no certificate.

    Raises
    ------
    ValueError
        If a file cannot be read or has other contents.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _prove(context, certificate, key)
    if authority is not None:
        _trust(context, authority)
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def client_context(
    certificate: str | os.PathLike[str], key: str | os.PathLike[str],
    authority: str | os.PathLike[str], check_name: bool,
) -> ssl.SSLContext:
    """Return a client's TLS context.

    Parameters
    ----------
    certificate, key : path
        The client's certificate and key, as in `server_context`.
    authority : path
        Certificate of the authority that signs the server's certificate, PEM.
    check_name : bool
        Whether the server's certificate must name the host.

    Raises
    ------
    ValueError
        If a file cannot be read or has other contents.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = check_name
    _prove(context, certificate, key)
    _trust(context, authority)
    return context


def _prove(
    context: ssl.SSLContext, certificate: str | os.PathLike[str],
    key: str | os.PathLike[str],
) -> None:
    context.minimum_version = ssl.TLSVersion.TLSv1_2    # the version that DV uses
    _check_readable("certificate", certificate)
    _check_readable("key", key)

    def refuse() -> str:        # otherwise OpenSSL asks for it at the terminal
        raise ValueError(f"key must have no passphrase, {os.fspath(key)} has one")

    try:
        context.load_cert_chain(certificate, key, refuse)
    except ssl.SSLError as error:
        raise ValueError(
            f"certificate and key must be PEM and belong together: {os.fspath(key)}: "
            f"{_reason(error)}") from None


def _trust(context: ssl.SSLContext, authority: str | os.PathLike[str]) -> None:
    _check_readable("authority", authority)
    try:
        context.load_verify_locations(authority)
    except ssl.SSLError as error:
        raise ValueError(f"authority must be a PEM certificate: {os.fspath(authority)}:"
                         f" {_reason(error)}") from None


def _check_readable(name: str, path: str | os.PathLike[str]) -> None:
    try:
        Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{name} must be a file that can be read: {error}") from None


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).replace("_", " ").lower()
