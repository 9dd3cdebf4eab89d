"""open_recording: open a recording of any format."""
from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Unpack

from pdavis_cv._options import changed, names_options
from pdavis_cv._remote import as_path, is_remote
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.base import Recording
from pdavis_cv.recording.options import SourceKeywords, SourceOptions
from pdavis_cv.recording.registry import FORMATS, first_bytes, format_of, read_with

AnySource = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""What can be opened: a path, a pattern of names, or several images in their order."""


@names_options(SourceOptions)
def open_recording(
    source: AnySource | Recording, options: SourceOptions | None = None,
    **changes: Unpack[SourceKeywords],
) -> Recording:
    """Open a recording of any format, which its first bytes determine, not its name.

    Parameters
    ----------
    source : path, sequence of paths, or Recording
        A file, or an object in a store such as ``s3://bucket/run.aedat4`` (extra
        ``[remote]``), which is read by ranges.  If a layout is given, also a grey
        video, image, TIFF stack or pattern of image names (``shot_%04d.png``,
        ``shot_*.png``) of a polarization camera; several paths are its images, in
        their order; four planes I0, I45, I90, I135 of each time need none.  A Recording
        is returned as it is.
    options : SourceOptions, optional
        Options to begin with; keywords override them.
    {options}
    **parameters
        Options of the file's format; see ``Format.read_options``.

    Returns
    -------
    Recording

    Raises
    ------
    RecordingError
        If the source cannot be opened or is not a recording; the message names the
        file, the byte and what was seen.
    LayoutError, ValueError
        If the recording has another layout or size than the caller says.
    TypeError
        If the format has no such option.

    Notes
    -----
    `pdavis_cv.formats` returns all formats; other packages add theirs through the
    entry-point group ``pdavis_cv.formats``.
    """
    if isinstance(source, Recording):
        return source
    options = changed(SourceOptions, options, changes)
    if options.isolated:    # here, as its process does not need it
        from pdavis_cv.recording.isolated import IsolatedRecording
        return IsolatedRecording(source, options)
    if not isinstance(source, str | os.PathLike):
        if not isinstance(source, Sequence) or not all(
                isinstance(one, str | os.PathLike) for one in source) or not source:
            raise TypeError(
                "source must be a path, or several of images, got "
                f"{type(source).__name__}; pdavis_cv.recording_from_arrays takes "
                'arrays, and pdavis_cv.open_source("usb:") a camera')
        if len(source) > 1:
            return read_with(FORMATS["images"], _images(source), options)
        [source] = source
    path = as_path(source)
    # A path that does not exist may be a pattern of image names.
    try:
        start = first_bytes(path) if is_remote(path) or path.exists() else b""
    except (OSError, ValueError) as error:  # a name too long
        raise RecordingError(f"{path}: cannot be opened: {error}") from None
    found = format_of(path, start)
    if found is None:       # here, as others need it not
        from pdavis_cv.recording.unknown import format_with
        found = format_with(options, path, start)
    if is_remote(path) and not found.by_ranges:
        raise RecordingError(
            f"{path}: {found.title} cannot be read by ranges: copy it to a disk")
    return read_with(found, source, options)


def _images(paths: Sequence[str | os.PathLike[str]]
            ) -> Sequence[str | os.PathLike[str]]:
    """Return paths after checking that none is a recording of another kind."""
    for one in paths:
        path = as_path(one)
        found = format_of(path, first_bytes(path))
        if found is not None and not found.needs_layout:
            raise RecordingError(
                f"{path}: {found.title}: only images are one recording together")
    return paths
