"""open_source(): opens a recording, or a live source by its address."""
from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, Unpack
from urllib.parse import parse_qsl

from pdavis_cv._options import changed, names_options
from pdavis_cv.errors import DeviceError
from pdavis_cv.live.base import Address, LiveSource
from pdavis_cv.recording.base import Source
from pdavis_cv.recording.open import AnySource, open_recording
from pdavis_cv.recording.options import SourceKeywords, SourceOptions
from pdavis_cv.registry import Registry

SOURCES: Registry[Callable[..., LiveSource]] = Registry("source", {
    "dv+tcp": "pdavis_cv.live.dv:open_tcp",
    "dv+tls": "pdavis_cv.live.dv:open_tls",
    "replay": "pdavis_cv.live.openers:open_replay",
    "simulate": "pdavis_cv.live.openers:open_simulation",
    "usb": "pdavis_cv.live.usb:open_usb",
}, LiveSource, attribute="scheme")
"""Live sources by the scheme of their addresses: what precedes the first colon."""


def is_address(where: object) -> bool:
    """Tell whether something is the address of a live source, such as ``"usb:"``."""
    return isinstance(where, str) and ":" in where and (
        where.partition(":")[0] in SOURCES)


@names_options(SourceOptions)
def open_source(
    where: AnySource | Source, options: SourceOptions | None = None,
    **changes: Unpack[SourceKeywords],
) -> Source:
    """Open a recording, or a device by its address.

    Parameters
    ----------
    where : path, address, sequence of paths, or Source
        A Source is returned as it is, and a path goes to `open_recording`.  Addresses
        are ``usb:`` or ``usb:SERIAL`` of a DAVIS346-based camera (``exposure_us=``,
        ``frame_interval_us=`` and its biases), ``dv+tcp://HOST:PORT``
        (``frames=`` a second port) and ``dv+tls://HOST:PORT`` (also ``certificate=``,
        ``key=`` and ``authority=``, PEM files, and ``check_name=1``) of what DV sends,
        ``replay:FILE`` (``speed=1``, 0 = as fast as it is read; ``loop=1``) and
        ``simulate:SCENE`` (``camera=typical``, ``size=48x48``, ``rpm=200``, ``seed=0``,
        and those of replay), followed by ``?name=value&...``.  The last two take
        ``seconds=``, after which they end.
    options : SourceOptions, optional
        Options to begin with; keywords override them.
    {options}
    **parameters
        Options of the file's format; see ``Format.read_options``.

    Returns
    -------
    Source
        A Recording for a path; else a LiveSource, which is read once.

    Raises
    ------
    RecordingError
        If a file cannot be opened or is not what it says.
    DeviceError
        If there is no such device, or the address is invalid.

    Examples
    --------
    >>> import pdavis_cv
    >>> from pdavis_cv.data import example_recording
    >>> with pdavis_cv.open_source(f"replay:{example_recording()}?speed=0") as source:
    ...     sum(len(packet.frames) for packet in source.packets())
    4
    """
    if isinstance(where, Source):
        return where
    options = changed(SourceOptions, options, changes)
    if not is_address(where):
        return open_recording(where, options)
    assert isinstance(where, str)
    scheme, _, rest = where.partition(":")
    target, _, query = rest.partition("?")
    try:
        values = dict(parse_qsl(query, keep_blank_values=True, strict_parsing=True)
                      if query else ())
        opener = SOURCES[scheme]
        opened = opener(Address(where, target, functools.partial(
            open_recording, options=options)), **options_of(opener, values))
        opened.state(options)
    except ValueError as error:
        raise DeviceError(f"{where}: {error}") from error
    return opened


def number(name: str, text: str, kind: Callable[[str], Any] = float) -> Any:
    """Return a value of an address as a number; a ValueError names it if it is none."""
    try:
        return kind(text)
    except ValueError:
        raise ValueError(f"{name} must be a number, got {text!r}") from None


def options_of(opener: Callable[..., Any], values: dict[str, str]) -> dict[str, Any]:
    """Return the values of an address as an opener's keyword arguments.

    Its keyword-only parameters are the names allowed, and their defaults tell the
    types; one with ``**values`` gets all texts.  Another name, or what is no number, is
    a ValueError.
    """
    known = inspect.signature(opener).parameters.values()
    if any(one.kind is one.VAR_KEYWORD for one in known):
        return dict(values)
    defaults = {one.name: one.default for one in known if one.kind is one.KEYWORD_ONLY}
    found: dict[str, Any] = {}
    for name, text in values.items():
        if name not in defaults:
            raise ValueError(f"there is no {name!r}; it takes {', '.join(defaults)}")
        kind = type(defaults[name])
        if kind is bool:
            found[name] = bool(number(name, text, int))
        else:
            found[name] = text if kind is str else number(name, text, kind)
    return found
