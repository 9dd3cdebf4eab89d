"""OME-TIFF: T, C, Y, X float32 with names, sizes, times and provenance.

Planes are streamed first; the directories and the OME-XML, which names every
plane's time, follow at the end, when they are known.  Memory does not grow.
"""
from __future__ import annotations

import os
import struct
import uuid
from itertools import product
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import escape, quoteattr

from pdavis_cv.export.provenance import to_json
from pdavis_cv.export.stacks import HEADER, StackFile

__all__ = ["OmeTiffFile"]

_OME = "http://www.openmicroscopy.org/Schemas/OME/2016-06"
# TIFF field types: 2 ASCII, 3 SHORT, 4 LONG, 16 LONG8.
_CLASSIC_END = 2**32 - 2**24


class OmeTiffFile(StackFile):
    """An OME-TIFF, readable by Fiji (Bio-Formats), napari, QuPath and tifffile.

    Channel ``AoP`` is in radians; units stand in the annotation that holds the
    provenance.  Files of 4 GB and more are BigTIFF.
    """

    def _finish(self) -> Path:
        end = self._data.seek(0, os.SEEK_END)
        xml = self._xml().encode()
        planes = self.count * len(self.quantities)
        big = end + len(xml) + 300 * planes > _CLASSIC_END
        _write_directories(self._data, end, xml, self.shape or (0, 0), planes, big)
        self._data.flush()
        os.fsync(self._data.fileno())
        self._data.close()
        return self.unfinished

    def _xml(self) -> str:
        height, width = self.shape or (0, 0)
        name = quoteattr(self.path.name.removesuffix(".tif").removesuffix(".ome"))
        first, channels = self.times_us[0], range(len(self.quantities))
        pixel = "" if self.pixel_um is None else (
            f' PhysicalSizeX="{self.pixel_um:.9g}" PhysicalSizeXUnit="&#181;m"'
            f' PhysicalSizeY="{self.pixel_um:.9g}" PhysicalSizeYUnit="&#181;m"')
        steps = {b - a for a, b in zip(
            self.times_us, self.times_us[1:], strict=False)}
        step = (f' TimeIncrement="{min(steps) / 1e6:.9g}" TimeIncrementUnit="s"'
                if steps and max(steps) - min(steps) <= 1 else "")
        parts = [
            f'<?xml version="1.0" encoding="UTF-8"?><OME xmlns="{_OME}"'
            ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
            f' xsi:schemaLocation="{_OME} {_OME}/ome.xsd"'
            f' UUID="urn:uuid:{uuid.uuid4()}" Creator="pdavis_cv">'
            f'<Image ID="Image:0" Name={name}><Pixels ID="Pixels:0"'
            f' DimensionOrder="XYCZT" Type="float" SizeX="{width}" SizeY="{height}"'
            f' SizeC="{len(self.quantities)}" SizeZ="1" SizeT="{self.count}"'
            f' BigEndian="false" Interleaved="false"{pixel}{step}>']
        parts += [f'<Channel ID="Channel:0:{c}" SamplesPerPixel="1"'
                  f' Name={quoteattr(self.quantities[c])}/>' for c in channels]
        parts.append(f'<TiffData IFD="0" PlaneCount="{self.count * len(channels)}"/>')
        parts += [f'<Plane TheZ="0" TheC="{c}" TheT="{t}"'
                  f' DeltaT="{(now - first) / 1e6:.6f}" DeltaTUnit="s"/>'
                  for (t, now), c in product(enumerate(self.times_us), channels)]
        facts = to_json({**self.facts, "first_t_us": first})
        parts.append(
            '</Pixels><AnnotationRef ID="Annotation:0"/></Image><StructuredAnnotations>'
            '<CommentAnnotation ID="Annotation:0" Namespace="pdavis_cv/provenance">'
            f"<Value>{escape(facts)}</Value></CommentAnnotation>"
            "</StructuredAnnotations></OME>")
        # TIFF text is ASCII: anything else as a character reference.
        return "".join(parts).encode("ascii", "xmlcharrefreplace").decode()


def _write_directories(
    file: BinaryIO, end: int, xml: bytes, shape: tuple[int, int], planes: int, big: bool
) -> None:
    """Write one directory per plane behind the data, and the header that finds them."""
    height, width = shape
    offset, count, entry = ("<Q", "<Q", "<HHQQ") if big else ("<I", "<H", "<HHII")
    long, word = (16, 8) if big else (4, 4)
    xml += b"\0"
    file.seek(end)
    padding = -end % 8
    file.write(bytes(padding) + xml + bytes(-len(xml) % 8))
    xml_at, at = end + padding, end + padding + len(xml) + (-len(xml) % 8)
    size = height * width * 4
    first = at
    for i in range(planes):
        fields = [(256, 4, width), (257, 4, height), (258, 3, 32), (259, 3, 1),
                  (262, 3, 1), (273, long, HEADER + i * size), (277, 3, 1),
                  (278, 4, height), (279, long, size), (339, 3, 3)]
        body = [struct.pack(entry, tag, kind, 1, value) for tag, kind, value in fields]
        if i == 0:
            body.insert(5, struct.pack(entry, 270, 2, len(xml), xml_at))
        used = struct.calcsize(count) + sum(map(len, body)) + word
        after = at + used + (-used % 8)
        last = i == planes - 1
        file.write(struct.pack(count, len(body)) + b"".join(body)
                   + struct.pack(offset, 0 if last else after)
                   + bytes(0 if last else after - at - used))
        at = after
    file.seek(0)
    file.write(struct.pack("<2sHHHQ", b"II", 43, 8, 0, first) if big
               else struct.pack("<2sHI", b"II", 42, first))
