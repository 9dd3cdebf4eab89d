"""The image files that a name, a pattern or a list of names denotes."""
from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from pdavis_cv._remote import as_path
from pdavis_cv.errors import RecordingError
from pdavis_cv.sensor import CHANNELS

TIFF_SUFFIXES = (".tif", ".tiff")
FIRST_NUMBERS = range(5)
"""Possible first numbers of a pattern, as in cv2.VideoCapture."""
_NUMBER = re.compile(r"%(0?\d{0,2})d")
_ANGLE = re.compile(r"(?<!\d)0{0,2}(0|45|90|135)(?!\d)")


def natural_order(names: Iterable[str]) -> list[str]:
    """Return names in the order of the numbers in them: 1, 2, .., 10."""
    return sorted(names, key=lambda name: [
        int(part) if k % 2 else part
        for k, part in enumerate(re.split("([0-9]+)", name))])


def names_of(source: str) -> list[str]:
    """Return the files that ``shot.png``, ``shot_%04d.png`` or ``shot_*.png`` denotes.

    Only the last part of a path may be a pattern; folders are taken as they are, if
    they exist.
    """
    path = Path(source)
    if path.is_dir():
        raise RecordingError(
            f"{source}: a folder, give a pattern such as {source}/*.png")
    if path.is_file():
        return [source]
    names: list[str] = []
    if found := _NUMBER.search(path.name):
        before, after = path.name[:found.start()], path.name[found.end():]

        def numbered(k: int) -> Path:
            return path.with_name(f"{before}{k:{found[1]}d}{after}".replace("%%", "%"))

        k = next((k for k in FIRST_NUMBERS if numbered(k).is_file()), None)
        while k is not None and numbered(k).is_file():
            names.append(os.fspath(numbered(k)))
            k += 1
    elif path.parent.is_dir():
        names = natural_order(
            os.fspath(path.parent / name)
            for name in glob.glob(path.name, root_dir=path.parent))
    else:
        names = natural_order(glob.glob(source))
    if not names:
        raise RecordingError(f"{source}: cannot be opened: no such file")
    for name in names:
        as_path(name)
    return names


def by_angle(names: Sequence[str]) -> list[list[str]] | None:
    """Return the files of each channel, if names differ only in a polarizer's angle.

    They are as ``a_I0.png``, ``a_I45.png``, ``a_I90.png``, ``a_I135.png``,
    ``b_I0.png``.  The order of the four lists is I0, I45, I90, I135; None if any file
    belongs to no four.
    """
    groups: dict[tuple[str, str], dict[int, str]] = {}
    for name in names:
        for angle in _ANGLE.finditer(name):
            group = groups.setdefault((name[:angle.start()], name[angle.end():]), {})
            group[int(angle[1])] = name
    whole = [group for group in groups.values() if len(group) == len(CHANNELS)]
    if not names or sorted(n for group in whole for n in group.values()) != sorted(
            names):
        return None
    first = natural_order(group[0] for group in whole)
    order = sorted(whole, key=lambda group: first.index(group[0]))
    return [[group[angle] for group in order] for angle in CHANNELS]


def is_four_planes(source: str) -> bool:
    """Return whether a name or pattern denotes planes I0, I45, I90, I135.

    These are a recording whatever the layout of a mosaic might be.
    """
    try:
        names = names_of(source)
        if by_angle(names) is not None:
            return True
        if Path(names[0]).suffix.lower() not in TIFF_SUFFIXES:
            return False
        from pdavis_cv.recording.images.tiff import TiffPictures  # slow to import
        return TiffPictures(names[0]).four
    except (OSError, ImportError):
        return False


def angles_of(stated: str, names: Sequence[str]) -> list[float]:
    """Return the angle in degrees of each file's polarizer.

    They are stated by ``"names"``: the last number that differs in them, as in
    ``pol_030.png``; by numbers with commas; or by the name of a text file with one
    number a line, which may follow the name of the image.
    """
    if stated == "names":
        found = [re.findall(r"\d+(?:\.\d+)?", Path(name).stem) for name in names]
        for column in reversed(list(zip(*found, strict=False))):
            if len(set(column)) > 1:
                return [float(number) for number in column]
        raise ValueError("analyser_steps: names must differ in an angle, as "
                         f"pol_030.png, got {Path(names[0]).name}")
    try:
        if not Path(stated).is_file():
            return [float(number) for number in stated.split(",")]
        rows = [line.replace(",", " ").split()
                for line in Path(stated).read_text().splitlines() if line.strip()]
        told = {row[0]: float(row[-1]) for row in rows if len(row) > 1}
        return [told[Path(name).name] for name in names] if told else [
            float(number) for number, in rows]
    except KeyError as error:
        raise ValueError(f"analyser_steps: {stated} has no angle of {error}") from None
    except ValueError:
        raise ValueError(
            "analyser_steps must be names, found, angles in degrees as 0,30,60, or a "
            f"text file of them, got {stated!r}") from None
